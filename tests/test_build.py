"""What the composition root counts, and which weights of a stored run it plays."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch

from atlantis_exp.build import count_update_flops, stored_weights
from atlantis_exp.commands.train import train
from atlantis_exp.config import Config
from atlantis_exp.faults import Fault
from atlantis_exp.game.emulator import ACTIONS
from atlantis_exp.training.trainer import Trainer


def test_the_operations_of_an_update_are_those_counted_by_hand(tiny: Callable[..., Config]) -> None:
    def convolution(channels: int, kernel: int, out: int, side: int) -> int:
        return 2 * channels * kernel**2 * out * side**2

    first = convolution(4, 8, 32, 20)
    others = convolution(32, 4, 64, 9) + convolution(64, 3, 64, 7) + 2 * 3_136 * 512 + 2 * 512 * 4
    forward = first + others
    backward = first + 2 * others  # no gradient of the observations
    sample = forward + backward
    dqn, double = tiny("env.size=84"), tiny("env.size=84", "objective=double_dqn")
    assert count_update_flops(dqn) == 4 * (sample + forward)
    assert count_update_flops(double) == 4 * (sample + 2 * forward)
    assert 4 * 1.8e9 < count_update_flops(tiny("model=resnet", "env.size=159")) < 4 * 1.9e9


@pytest.mark.slow
def test_a_run_without_checkpoints_plays_from_the_weights_of_its_evaluations(tiny: Callable[..., Config]) -> None:
    config = tiny()
    train(config)
    folder = Path(config.paths.outputs) / "runs" / config.run_name()

    def stored(weights: str) -> tuple[dict[str, list[Any]], int]:
        content, step = stored_weights(config, folder, weights)
        return {name: tensor.tolist() for name, tensor in safetensors.torch.load(content).items()}, step

    with_checkpoints = [stored("latest"), stored("best")]
    shutil.rmtree(folder / "checkpoints")
    assert [stored("latest"), stored("best")] == with_checkpoints
    assert with_checkpoints[0][1] == 160
    shutil.rmtree(folder)
    with pytest.raises(Fault, match="neither a checkpoint nor an evaluation"):
        stored("latest")


def test_with_an_average_it_is_what_is_evaluated_and_stored(
    tiny: Callable[..., Config], started: Callable[[Config, Path], Trainer], tmp_path: Path
) -> None:
    """The network holds one action, its average another."""
    config = tiny("training.ema=10", "evaluation.epsilon=0", "budget.steps=1")
    trainer = started(config, tmp_path)
    learner = trainer.learner
    for network, action in ((learner.network, "RIGHTFIRE"), (learner.evaluated, "FIRE")):
        with torch.no_grad():
            [*network.parameters()][-1][ACTIONS.index(action)] += 1_000
    trainer.run()
    assert trainer.last_metrics["actions/FIRE"] == 1
    average = safetensors.torch.save(learner.evaluated.state_dict())
    assert average != safetensors.torch.save(learner.network.state_dict())
    for weights in ("latest", "best"):
        assert stored_weights(config, tmp_path, weights) == (average, 1)
