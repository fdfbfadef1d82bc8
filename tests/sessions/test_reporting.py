"""The table of results."""

import json
import math
from collections.abc import Callable
from pathlib import Path

import pytest

from atlantis_exp.commands.report import VERB
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.runs.folder import EVALUATED, RunFolder
from atlantis_exp.runs.journal import Journal
from atlantis_exp.sessions.reporting import report


def test_a_report_on_an_empty_folder_says_so_and_creates_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report(tmp_path / "nothing")
    assert capsys.readouterr().out == f"no run under {tmp_path}/nothing/runs yet\n"
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
    report(tmp_path)
    shown = capsys.readouterr().out
    assert f"the MLflow UI: python -m atlantis_exp ui paths.outputs={tmp_path} (publishes 2 runs that it lacks" in shown
    none, two = (line for line in shown.splitlines() if line.startswith("│"))
    assert none.replace("│", "").split() == ["none", "interrupted"]
    assert two.replace("│", "").split() == ["two", "1,000", "(interrupted)", *["1,000"] * 6, "100025.0%", "1000"]

    (run.path / "journal.jsonl").write_bytes((run.path / "journal.jsonl").read_bytes().replace(b"{", b"[", 1))
    with pytest.raises(Fault, match=r"^left out two: run two: .*byte 0"):
        report(tmp_path)
    (shown,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("│"))
    assert shown.replace("│", "").split() == ["none", "interrupted"]


def test_a_run_that_is_made_longer_has_its_last_evaluation(
    recorded: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = recorded("budget.steps=160", outcome="budget")
    journal = Journal(folder)
    journal.resume()
    journal.metrics(dict.fromkeys(EVALUATED, 7_777.0), 500)
    journal.flush()
    journal.status("KILLED")
    report(tmp_path)
    (row,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("│"))
    assert row.replace("│", "").split()[1:4] == ["500", "(interrupted)", "7,777"]


def test_a_score_that_is_no_number_is_left_blank(
    recorded: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recorded() / "result.json"
    stored = json.loads(path.read_text())
    stored["evaluation"]["evaluation/mean"] = math.nan
    stored["counts"] = {"flops": 5.0}  # without updates
    path.write_text(json.dumps(stored))
    report(tmp_path)
    (row,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("│"))
    assert row.split("│")[3].strip() == ""
    assert row.split("│")[4].strip()
    assert RunFolder(path.parent).beyond({"budget.flops": 1.0}) is None


def test_a_run_is_one_line_and_chosen_by_name_and_config(
    recorded: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = {
        (model, seed): recorded(f"model={model}", f"seed={seed}").name
        for model in ("cnn", "resnet")
        for seed in (1, 12)
    }

    def shown(*words: str) -> set[str]:
        VERB.run([*words, f"paths.outputs={tmp_path}"])
        rows = [line.split()[1] for line in capsys.readouterr().out.splitlines() if line.startswith("│")]
        assert len(rows) == len(set(rows))
        return set(rows)

    assert shown() == set(names.values())
    assert shown("runs=cnn,resnet-uniform-s1") == {names["cnn", 1], names["cnn", 12], names["resnet", 1]}
    assert shown("where=seed=12,model=resnet") == {names["resnet", 12]}
    assert shown("runs=cnn", "where=seed=1") == {names["cnn", 1]}
    with pytest.raises(ConfigError, match=r"^where=sed: no such key; did you mean 'seed'"):
        report(tmp_path, where=["sed=1"])
    with pytest.raises(ConfigError, match=r"^runs=cmn: no such run under"):
        report(tmp_path, ["cmn"])
