"""A sweep and its page, in a real store: whatever process trains the runs, and however it ends."""

import csv
import dataclasses
import os
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from atlantis_exp.commands.jobs import words_of
from atlantis_exp.config import Config
from atlantis_exp.faults import ConfigError
from atlantis_exp.runs.journal import Journal, read_commit
from atlantis_exp.sessions.job import Job, replaced
from atlantis_exp.sessions.sweep import ledger
from atlantis_exp.sessions.training import train

Compose = Callable[..., Config]
REPOSITORY = Path(__file__).parents[2]
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


def test_a_result_without_its_hours_has_a_row_without_them(pair: list[Job], recorded: Callable[..., Path]) -> None:
    for seed in (0, 1):
        recorded(*SHORT, f"seed={seed}")  # its counts are empty
    with ledger(pair, ["seed=0,1"]):
        pass
    assert tags(pair[0].outputs, "mlflow.note.content")["sweep seed=0,1"].count("| done | 160 |") == 2


def test_why_a_run_failed_takes_no_hold_of_the_terminal(
    tiny: Compose, recorded: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    Journal(recorded()).status("FAILED", "no \x1b]52;c;cm0=\x07device")
    with ledger([Job(tiny())]):
        pass
    assert ": no ]52;c;cm0=device\n" in capsys.readouterr().out


@pytest.mark.slow
def test_runs_trained_by_processes_of_their_own_have_one_parent_and_a_repeated_sweep_the_same(
    pair: list[Job], tiny_overrides: tuple[str, ...]
) -> None:
    outputs = pair[0].outputs
    with ledger(pair, ["seed=0,1"]):
        command = (sys.executable, "-m", "atlantis_exp", *replaced(tiny_overrides, *SHORT, f"paths.outputs={outputs}"))
        processes = [
            subprocess.Popen((*command, f"seed={job.config.seed}"), cwd=REPOSITORY, stdout=subprocess.DEVNULL)
            for job in pair
        ]
        assert [process.wait() for process in processes] == [0, 0]
    sweeps = rows(outputs, "SELECT run_uuid, status FROM runs WHERE name = 'sweep seed=0,1'")
    assert sweeps == [(sweeps[0][0], "FINISHED")]
    children = tags(outputs, "mlflow.parentRunId")
    assert len(children) == 2
    assert set(children.values()) == {sweeps[0][0]}
    note = tags(outputs, "mlflow.note.content")["sweep seed=0,1"]
    assert all(f"| {name} | done | 80 |" in note for name in children)
    assert "| cnn uniform quick" in note  # the group of both
    page = next((outputs / "sweeps").glob("sweep-*")) / "artifacts"
    table = list(csv.DictReader((page / "runs.csv").open()))
    assert {line["run"] for line in table} == {job.config.run_name() for job in pair}
    assert {path.name for path in page.glob("*.png")} == {"curves.png", "scores.png"}

    with ledger(pair, ["seed=0,1"]):
        for job in pair:
            train(job)
    assert rows(outputs, "SELECT run_uuid, status FROM runs WHERE name = 'sweep seed=0,1'") == sweeps
    assert len(list((page / "images").rglob("*.png"))) == 2


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


@pytest.mark.parametrize("how", ["exit", "terminated", "interrupted"])
def test_a_sweep_that_is_cut_short_is_closed(pair: list[Job], how: str) -> None:
    of_term = signal.getsignal(signal.SIGTERM)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell's background job lacks

    def sweep() -> None:
        with ledger(pair, ["seed=0,1"]):
            if how == "exit":
                sys.exit(3)
            os.kill(os.getpid(), signal.SIGTERM if how == "terminated" else signal.SIGINT)
            signal.pause()

    with pytest.raises((SystemExit, KeyboardInterrupt)):
        sweep()
    signal.signal(signal.SIGINT, before)
    (folder,) = (pair[0].outputs / "sweeps").glob("sweep-*")
    commit = read_commit(folder)
    assert commit is not None
    assert commit.status == "KILLED"
    assert signal.getsignal(signal.SIGTERM) is of_term


def test_a_larger_sweep_takes_the_runs_of_a_smaller_one_over(pair: list[Job], tiny: Compose) -> None:
    with ledger(pair, ["seed=0,1"]):
        pass
    small = {read_commit(path).parent for path in (pair[0].outputs / "runs").iterdir()}  # type: ignore[union-attr]
    with ledger([*pair, Job(tiny(*SHORT, "seed=2"))], ["seed=0,1,2"]):
        pass
    large = {read_commit(path).parent for path in (pair[0].outputs / "runs").iterdir()}  # type: ignore[union-attr]
    assert len(small) == len(large) == 1
    assert small != large


def test_a_sweep_that_is_not_tracked_leaves_nothing_but_its_runs(tiny: Compose) -> None:
    config = tiny()
    with ledger([Job(config), Job(tiny("seed=1"))], ["seed=0,1"]):
        pass
    assert not list(Path(config.paths.outputs).iterdir())
