"""Which weights of a stored run are played."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch

from atlantis_exp.checking import to_dict
from atlantis_exp.config import Config
from atlantis_exp.faults import Fault
from atlantis_exp.game.emulator import ACTIONS
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.sessions.job import Job
from atlantis_exp.sessions.training import train
from atlantis_exp.sessions.weights import stored_weights
from atlantis_exp.training.trainer import Trainer


@pytest.mark.slow
def test_a_run_without_checkpoints_plays_from_the_weights_of_its_evaluations(tiny: Callable[..., Config]) -> None:
    config = tiny()
    train(Job(config))
    run = RunFolder.of(config)

    def stored(weights: str) -> tuple[dict[str, list[Any]], int]:
        content, step = stored_weights(run, weights)
        return {name: tensor.tolist() for name, tensor in safetensors.torch.load(content).items()}, step

    with_checkpoints = [stored("latest"), stored("best")]
    shutil.rmtree(run.checkpoints)
    assert [stored("latest"), stored("best")] == with_checkpoints
    assert with_checkpoints[0][1] == 160
    shutil.rmtree(run.path)
    run.write_config(to_dict(config))
    with pytest.raises(Fault, match="neither a checkpoint nor an evaluation"):
        stored("latest")


def test_with_an_average_it_is_what_is_evaluated_and_stored(
    tiny: Callable[..., Config], started: Callable[[Config, Path], Trainer], tmp_path: Path
) -> None:
    """The network holds one action, its average another."""
    config = tiny("training.ema=10", "evaluation.epsilon=0", "budget.steps=1")
    run = RunFolder(tmp_path)
    run.write_config(to_dict(config))
    trainer = started(config, tmp_path)
    learner = trainer.learner
    for network, action in ((learner.network, "RIGHTFIRE"), (learner.evaluated, "FIRE")):
        with torch.no_grad():
            [*network.parameters()][-1][ACTIONS.index(action)] += 1_000
    trainer.run()
    assert trainer.recorder.last_metrics["actions/FIRE"] == 1
    average = safetensors.torch.save(learner.evaluated.state_dict())
    assert average != safetensors.torch.save(learner.network.state_dict())
    for weights in ("latest", "best"):
        assert stored_weights(run, weights) == (average, 1)
