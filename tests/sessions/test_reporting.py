"""The table of results, where there is none yet."""

from collections.abc import Callable
from pathlib import Path

import pytest

from atlantis_exp.config import PathsConfig
from atlantis_exp.faults import Fault
from atlantis_exp.runs.folder import EVALUATED, RunFolder
from atlantis_exp.runs.journal import Journal
from atlantis_exp.sessions.reporting import report


def test_a_report_on_an_empty_folder_says_so_and_creates_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report(paths=PathsConfig(outputs=str(tmp_path / "nothing")))
    assert capsys.readouterr().out == f"there is no run under {tmp_path}/nothing/runs yet\n"
    assert not (tmp_path / "nothing").exists()


def test_a_run_that_has_not_ended_has_its_last_evaluation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, steps in (("none", ()), ("two", (500, 1_000))):
        run = RunFolder(tmp_path / "runs" / name)
        run.path.mkdir(parents=True)
        run.write_config({})
        journal = Journal(run.path)
        journal.metrics({"score/episode": 5.0}, 10)
        for step in steps:
            journal.metrics(dict.fromkeys(EVALUATED, step + 0.25), step)
        journal.metrics({"evaluation/mean": 7.0}, 2_000)  # no whole one
        journal.flush()
    report(paths=PathsConfig(outputs=str(tmp_path)))
    shown = capsys.readouterr().out
    assert f"the MLflow UI: python -m atlantis_exp ui paths.outputs={tmp_path} (publishes 2 runs that it lacks" in shown
    none, two = (line for line in shown.splitlines() if line.startswith("│"))
    assert none.replace("│", "").split() == ["none", "interrupted"]
    assert two.replace("│", "").split() == ["two", "1,000", "(interrupted)", *["1,000"] * 6, "100025.0%", "1000"]

    (run.path / "journal.jsonl").write_bytes((run.path / "journal.jsonl").read_bytes().replace(b"{", b"[", 1))
    with pytest.raises(Fault, match=r"^run two: .*byte 0"):
        report(paths=PathsConfig(outputs=str(tmp_path)))


def test_a_run_that_is_made_longer_has_its_last_evaluation(
    recorded: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = recorded("budget.steps=160", outcome="budget")
    journal = Journal(folder)
    journal.resume()
    journal.metrics(dict.fromkeys(EVALUATED, 7_777.0), 500)
    journal.flush()
    journal.status("KILLED")
    report(paths=PathsConfig(outputs=str(tmp_path)))
    (row,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("│"))
    assert row.replace("│", "").split()[1:4] == ["500", "(interrupted)", "7,777"]
