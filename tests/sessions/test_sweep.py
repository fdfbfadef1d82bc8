"""A sweep and its page, in a real store: whatever process trains the runs, and however it ends."""

import csv
import dataclasses
import re
import signal
import sqlite3
import threading
import time
from collections.abc import Callable
from contextlib import closing, nullcontext
from pathlib import Path
from typing import Any

import pytest

from atlantis_exp.commands.jobs import words_of
from atlantis_exp.config import Config
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.journal import NOTE, Artifact, Journal, Tags
from atlantis_exp.sessions.job import Job, fitted
from atlantis_exp.sessions.launchers import BASIC, Launcher
from atlantis_exp.sessions.sweep import _every, ledger, say_hours
from atlantis_exp.sessions.training import measure, train
from atlantis_exp.tracking.publishing import catch_up
from atlantis_exp.training.forecast import Forecast
from atlantis_exp.training.trainer import Trainer

Compose = Callable[..., Config]
ELSEWHERE = Launcher("elsewhere")  # none that needs a library
SHORT = ("tracking=mlflow", "tracking.every_steps=20", "phase.quick.steps=80", "evaluation.every_steps=null")


@pytest.fixture
def pair(tiny: Compose, tiny_overrides: tuple[str, ...]) -> list[Job]:
    """A sweep of two seeds."""
    return [Job(tiny(*SHORT, f"seed={seed}"), words_of([*tiny_overrides, *SHORT])) for seed in (0, 1)]


def rows(outputs: Path, query: str, *values: Any) -> list[tuple[Any, ...]]:
    with closing(sqlite3.connect(outputs / "mlflow.db")) as database:
        return database.execute(query, values).fetchall()


def tags(outputs: Path, key: str) -> dict[str, str]:
    """Of the runs that bear it, by name."""
    return dict(rows(outputs, "SELECT name, value FROM tags JOIN runs USING (run_uuid) WHERE key = ?", key))


def page_of(outputs: Path) -> RunFolder:
    (path,) = (outputs / "sweeps").iterdir()
    return RunFolder(path)


def note_of(folder: RunFolder) -> str:
    notes = [record.values[NOTE] for record in folder.records() if isinstance(record, Tags) and NOTE in record.values]
    return notes[-1]


def test_a_page_tells_of_each_run_how_far_it_is_and_why_it_failed(
    tiny: Compose, recorded: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    jobs = [Job(tiny(f"seed={seed}")) for seed in range(5)]
    done, without_hours, failed, unsaid, queued = (RunFolder.of(job.config) for job in jobs)
    for folder in (done, without_hours, failed):
        recorded(f"seed={folder.name.split('-')[2][1:]}", scores=(1_000.0, 3_000.0))
    result = done.result
    assert result is not None
    done.write_result(dataclasses.replace(result, counts={"hours": 1.5, "episodes": 7}))
    Journal(failed.path).status("FAILED", "no device")
    (failed.path / "traceback.txt").write_text("...")
    with ledger([*jobs, jobs[0]], ["seed=0,1,2,3,4"], ELSEWHERE, "train -m seed=0,1,2,3,4"):
        assert page_of(tmp_path).status == "RUNNING"
        assert note_of(page_of(tmp_path)).count("\n| cnn uniform s") == 5
        Journal(unsaid.path).status("FAILED", "no space")
    page = page_of(tmp_path)
    assert (page.status, page.title) == ("FAILED", "sweep seed=0,1,2,3,4")
    assert page.error == f"2 of 5 runs failed\n{failed.name}: no device\n{unsaid.name}: no space"
    assert note_of(page).splitlines() == [
        "- **cnn uniform s2 failed**: no device (details in `traceback.txt` of the run)",
        "- **cnn uniform s3 failed**: no space",
        "",
        "| run | state | steps | mean | +- | median | IQM | high | low | hours |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
        "| cnn uniform s0 | done | 160 | 2,000 | 1,000 | 2,000 | 2,000 | 3,000 | 1,000 | 1.50 |",
        "| cnn uniform s1 | done | 160 | 2,000 | 1,000 | 2,000 | 2,000 | 3,000 | 1,000 |  |",
        "| cnn uniform s2 | failed | 160 | 2,000 | 1,000 | 2,000 | 2,000 | 3,000 | 1,000 |  |",
        "| cnn uniform s3 | failed |  |  |  |  |  |  |  |  |",
        "| cnn uniform s4 | queued |  |  |  |  |  |  |  |  |",
    ]
    table = list(csv.DictReader(page.artifact("runs.csv").open()))
    assert [(row["run"], row["title"], row["state"]) for row in table] == [
        *((done.name, "cnn uniform s0", "done"), (without_hours.name, "cnn uniform s1", "done")),
        *((failed.name, "cnn uniform s2", "failed"), (unsaid.name, "cnn uniform s3", "failed")),
        (queued.name, "cnn uniform s4", "queued"),
    ]
    assert (table[0]["steps"], table[0]["hours"], table[0]["evaluation/mean"]) == ("160", "1.5", "2000.0")
    assert (table[3]["steps"], table[3]["hours"], table[3]["evaluation/mean"]) == ("", "", "")
    artifacts = {record.path for record in page.records() if isinstance(record, Artifact)}
    assert artifacts == {"runs.csv"}
    shown = capsys.readouterr().out.splitlines()
    assert "sweep of 5 runs: 2 done, 1 failed, 2 queued" in shown  # before
    assert shown[-6:] == [
        f"  done        {done.name}",
        f"  done        {without_hours.name}",
        f"  failed      {failed.name}: no device ({failed.path / 'traceback.txt'})",
        f"  failed      {unsaid.name}: no space",
        f"  queued      {queued.name}",
        "sweep of 5 runs: 2 done, 2 failed, 1 queued",
    ]


def test_reasons_take_a_quarter_of_the_note_at_most(tiny: Compose, tmp_path: Path) -> None:
    jobs = [Job(tiny(f"seed={seed}")) for seed in range(6)]
    for job in jobs:
        Journal(RunFolder.of(job.config).path).status("FAILED", "x" * 600)
    with ledger(jobs, [], ELSEWHERE):
        pass
    note = note_of(page_of(tmp_path))
    assert note.count("x" * 600) == 3
    assert "... and 3 more in `runs.csv`.\n\n| run |" in note
    assert note.count("| failed |") == 6


@pytest.mark.parametrize(
    ("are_done", "error", "status", "reason"),
    [
        (True, None, "FINISHED", ""),
        (False, None, "KILLED", ""),
        (True, Fault("no more"), "FAILED", "no more"),
        (False, Fault("late", exit_code=124), "KILLED", "late"),
        (False, SystemExit(3), "KILLED", ""),
    ],
    ids=repr,
)
def test_a_sweep_is_finished_once_all_its_runs_are(
    tiny: Compose,
    recorded: Callable[..., Path],
    tmp_path: Path,
    are_done: bool,
    error: BaseException | None,
    status: str,
    reason: str,
) -> None:
    recorded("seed=0")
    if are_done:
        recorded("seed=1")
    with (
        pytest.raises(type(error)) if error else nullcontext(),
        ledger([Job(tiny("seed=0")), Job(tiny("seed=1"))], ["seed=0,1"], ELSEWHERE),
    ):
        if error:
            raise error
    assert (page_of(tmp_path).status, page_of(tmp_path).error) == (status, reason)


def test_a_sweep_says_how_many_trainings_go_on_at_a_time_and_for_how_long(
    tiny: Compose, recorded: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    jobs = [Job(tiny(f"seed={seed}", "budget.forecast=warn")) for seed in (0, 1)]
    hours: list[float] = []

    def measured(job: Job, cores: int | None) -> tuple[Trainer, Forecast]:
        trainer, forecast = measure(job, cores)
        hours.append(forecast.hours)
        return trainer, forecast

    monkeypatch.setattr("atlantis_exp.sessions.sweep.measure", measured)
    say_hours(jobs, Launcher("joblib", {"n_jobs": 8, "cores": 1}))
    assert 0 < hours[0] < 1
    told = capsys.readouterr().out.splitlines()[-1]
    assert re.fullmatch(r"8 trainings at a time, 1 core each: about .+ if all take as long as cnn uniform s0", told)
    say_hours([Job(tiny())], Launcher("joblib", {"n_jobs": 2, "cores": 2}))  # a forecast is not wanted
    assert capsys.readouterr().out == "2 trainings at a time, 2 cores each\n"
    for seed in (0, 1):
        recorded(f"seed={seed}")
    say_hours(jobs, BASIC)
    assert capsys.readouterr().out == ""


@pytest.mark.usefixtures("impatient")
def test_a_launchers_sweep_puts_aside_what_is_to_be_begun_anew_but_what_another_process_trains(
    tiny: Compose, recorded: Callable[..., Path], tmp_path: Path
) -> None:
    jobs = [Job(tiny("resume=never", f"seed={seed}")) for seed in (0, 1)]
    here, elsewhere = (RunFolder.of(job.config) for job in jobs)
    for seed in (0, 1):
        recorded(f"seed={seed}")
    with elsewhere.held(), ledger(jobs, ["seed=0,1"], ELSEWHERE):
        assert not here.has_started
        assert here.path.with_name(f"{here.name}~1").exists()
        assert here.parent is not None
        assert here.parent.resolve() == page_of(tmp_path).path
        assert elsewhere.has_started
        assert elsewhere.parent is None
    with pytest.raises(Fault, match="is held by"), page_of(tmp_path).held(), ledger(jobs, ["seed=0,1"], ELSEWHERE):
        pass
    assert elsewhere.parent is None  # it is not taken over by a sweep that may not begin


def test_something_is_looked_at_again_and_again_whatever_one_look_meets_until_it_is_closed() -> None:
    looks = []

    def look() -> None:
        looks.append(time.monotonic())
        raise (OSError, ValueError, Fault("x"))[len(looks) % 3]

    with _every(0.01, look):
        patience = time.monotonic() + 60
        while len(looks) < 4:
            assert time.monotonic() < patience
            time.sleep(0.01)
    seen = len(looks)
    time.sleep(0.05)
    assert len(looks) == seen
    with pytest.raises(KeyError), _every(0.01, looks.clear):
        raise KeyError
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("every")]


def test_why_a_run_failed_takes_no_hold_of_the_terminal(
    tiny: Compose, recorded: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    Journal(recorded()).status("FAILED", "no \x1b]52;c;cm0=\x07device")
    with ledger([Job(tiny())]):
        pass
    assert ": no ]52;c;cm0=device\n" in capsys.readouterr().out


@pytest.mark.slow
def test_a_job_that_fails_is_shown_as_failed_with_its_error_and_so_is_its_sweep(pair: list[Job]) -> None:
    outputs = pair[0].outputs
    broken = dataclasses.replace(pair[1], config=dataclasses.replace(pair[1].config, device="cuda:9"))

    def sweep() -> None:
        with ledger(pair, ["seed=0,1"]):
            train(pair[0])
            train(broken)

    with pytest.raises(ConfigError, match="no CUDA device"):
        sweep()
    states = dict(rows(outputs, "SELECT name, status FROM runs"))
    assert sorted(states.values()) == ["FAILED", "FAILED", "FINISHED"]
    errors = tags(outputs, "error")
    assert "1 of 2 runs failed" in errors.pop("sweep seed=0,1")
    ((name, error),) = errors.items()
    assert "no CUDA device" in error
    assert f"**{name} failed**: {error}" in tags(outputs, "mlflow.note.content")["sweep seed=0,1"]
    assert len(set(tags(outputs, "mlflow.parentRunId").values())) == 1


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_sweep_that_a_signal_ends_is_closed(tiny: Compose, tmp_path: Path, number: int) -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell's background job lacks

    def sweep() -> None:
        with ledger([Job(tiny())], [], ELSEWHERE):
            signal.raise_signal(number)

    with pytest.raises((SystemExit, KeyboardInterrupt)):
        sweep()
    signal.signal(signal.SIGINT, before)
    assert page_of(tmp_path).status == "KILLED"


def test_a_launchers_sweep_marks_what_was_killed_before_it(tiny: Compose, tmp_path: Path) -> None:
    Journal(tmp_path / "runs" / "killed").status("RUNNING")
    with ledger([Job(tiny())], [], ELSEWHERE):
        assert RunFolder(tmp_path / "runs" / "killed").status == "KILLED"


def test_a_launchers_sweep_shows_its_runs_while_other_processes_train_them(
    tiny: Compose,
    recorded: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("TTY_COMPATIBLE", "1")  # a terminal is drawn on once a second
    shown = ""
    with ledger([Job(tiny(f"seed={seed}")) for seed in (0, 1)], ["seed=0,1"], ELSEWHERE):
        recorded("seed=0")
        patience = time.monotonic() + 60
        while not re.search(r"cnn uniform s0 +done +200 of", shown):
            assert time.monotonic() < patience
            time.sleep(0.1)
            shown += capsys.readouterr().out
    assert re.search(r"cnn uniform s1 +queued", shown)


@pytest.mark.slow
def test_a_launchers_sweep_publishes_the_runs_that_other_processes_train(
    pair: list[Job], recorded: Callable[..., Path]
) -> None:
    outputs = pair[0].outputs
    with ledger(pair, ["seed=0,1"], ELSEWHERE):
        recorded(*SHORT, "seed=1")
    for _ in range(5):
        catch_up(outputs)  # a busy machine may not have sent all of it in time
    assert len(rows(outputs, "SELECT name FROM runs")) == 2


def test_a_sweep_that_is_not_tracked_leaves_nothing_but_its_runs(tiny: Compose) -> None:
    config = tiny()
    with ledger([Job(config), Job(tiny("seed=1"))], ["seed=0,1"]):
        pass
    assert not list(Path(config.paths.outputs).iterdir())


@pytest.mark.parametrize("room", [0, 59, 60, 200, 1_099, 1_100])
def test_a_table_in_a_note_keeps_to_its_room_and_says_what_it_leaves_out(room: int) -> None:
    lines = [f"line {number:05}" for number in range(100)]  # 100 x 10 characters, and 99 ends
    text = fitted(lines, room, "`x.csv`")
    kept, _, left = text.partition("\n\n... and ")
    shown = kept.splitlines()
    assert shown == lines[: len(shown)]
    assert left == ("" if room >= 1_099 else f"{100 - len(shown)} more in `x.csv`.")
    assert len(text) <= max(room, 60)
    assert len(shown) >= (room - 60) // 11
