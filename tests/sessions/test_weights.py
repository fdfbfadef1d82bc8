"""Stored weights: those that the last commit speaks of, or none."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from atlantis_exp.config import Config
from atlantis_exp.faults import Fault
from atlantis_exp.replay.memory import ReplayMemory
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.sessions.job import Job
from atlantis_exp.sessions.training import train
from atlantis_exp.sessions.weights import stored_weights
from atlantis_exp.training.checkpoint import Checkpoints
from atlantis_exp.training.recorder import Recorder

Compose = Callable[..., Config]


class Killed(BaseException): ...


@pytest.fixture
def interrupted(tiny: Compose, monkeypatch: pytest.MonkeyPatch) -> RunFolder:
    """A run with the best evaluation at step 160, which was killed before it was committed; the commit is of 120."""
    config = tiny("tracking.commit_episodes=1", "phase.quick.steps=160")
    save, evaluate = Checkpoints.save, Recorder.evaluate

    def saved(self: Checkpoints, state: Mapping[str, Any], memory: ReplayMemory) -> None:
        if state["evaluated_at"] == 160:
            raise Killed
        save(self, state, memory)

    def evaluated(self: Recorder, *arguments: Any) -> None:
        self.done.best_mean = None  # each evaluation is the best so far
        evaluate(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(Checkpoints, "save", saved)
        patch.setattr(Recorder, "evaluate", evaluated)
        with pytest.raises(Killed):
            train(Job(config))
    return RunFolder.of(config)


def test_best_is_what_the_last_commit_says(interrupted: RunFolder) -> None:
    files = interrupted.artifact("models/network")
    assert {path.name for path in files.iterdir()} == {"80.safetensors", "160.safetensors"}
    weights, step = stored_weights(interrupted, "best")
    assert (step, weights) == (80, (files / "80.safetensors").read_bytes())
    assert weights != (files / "160.safetensors").read_bytes()


def test_a_damaged_journal_of_a_folder_without_checkpoints_is_one_line(recorded: Callable[..., Path]) -> None:
    run = RunFolder(recorded())
    journal = run.path / "journal.jsonl"
    journal.write_bytes(journal.read_bytes().replace(b"{", b"[", 1))
    with pytest.raises(Fault, match=f"^run {run.name}: .*byte 0"):
        stored_weights(run, "best")


@pytest.mark.slow
def test_the_run_goes_on_with_the_best_of_its_last_commit(tiny: Compose, interrupted: RunFolder) -> None:
    train(Job(tiny("tracking.commit_episodes=1", "phase.quick.steps=160")))
    weights, step = stored_weights(interrupted, "best")
    assert interrupted.artifact(f"models/network/{step}.safetensors").read_bytes() == weights
