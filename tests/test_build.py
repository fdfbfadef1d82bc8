"""What is built from a config, counted."""

import os
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import cast

import pytest
import safetensors.torch
import torch

from atlantis_exp import build
from atlantis_exp.build import (
    build_evaluator,
    build_learner,
    build_memory,
    build_network_actor,
    import_components,
    make_emulator,
)
from atlantis_exp.config import Config
from atlantis_exp.faults import ConfigError
from atlantis_exp.game.vector import ProcessEmulators, make_emulators
from atlantis_exp.learning.recurrent import RecurrentLearner
from atlantis_exp.replay.memory import ReplayMemory
from atlantis_exp.sessions.processor import set_up_torch
from atlantis_exp.training.actor import RecurrentGreedy
from atlantis_exp.training.trainer import Trainer

REPOSITORY = Path(__file__).parents[1]


def test_the_operations_of_an_update_are_those_counted_by_hand(tiny: Callable[..., Config]) -> None:
    def convolution(channels: int, kernel: int, out: int, side: int) -> int:
        return 2 * channels * kernel**2 * out * side**2

    def counted(*overrides: str) -> int:
        config = tiny(*overrides)
        return build_learner(config).update_flops((4, config.env.size, config.env.size), config.training.batch_size)

    first = convolution(4, 8, 32, 20)
    others = convolution(32, 4, 64, 9) + convolution(64, 3, 64, 7) + 2 * 3_136 * 512 + 2 * 512 * 4
    forward = first + others
    backward = first + 2 * others  # no gradient of the observations
    sample = forward + backward
    assert counted("env.size=84") == 4 * (sample + forward)
    assert counted("env.size=84", "objective=double_dqn") == 4 * (sample + 2 * forward)
    assert 4 * 1.8e9 < counted("model=resnet", "env.size=159") < 4 * 1.9e9


@pytest.mark.parametrize(
    ("capabilities", "precision"),
    [
        ({"cpu_name": "Intel Xeon", "avx512_bf16": True, "amx_bf16": True}, "bf16"),
        ({"cpu_name": "Intel Xeon", "avx512_bf16": True, "amx_bf16": False}, "fp32"),
        ({"cpu_name": "AMD EPYC", "avx512_bf16": True, "amx_bf16": False}, "bf16"),
        ({"cpu_name": "AMD EPYC", "avx512_bf16": False, "amx_bf16": False}, "fp32"),
        ({"architecture": "arm64"}, "fp32"),
    ],
)
def test_the_automatic_precision_is_the_faster_one(
    capabilities: dict[str, object], precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities)
    assert build.choose_precision("auto", torch.device("cpu")) == precision
    assert build.choose_precision("bf16", torch.device("cpu")) == "bf16"


@pytest.mark.parametrize(("capability", "precision"), [((7, 5), "fp32"), ((8, 0), "bf16"), ((9, 0), "bf16")])
def test_a_gpu_without_bf16_of_its_own_is_given_fp32(
    capability: tuple[int, int], precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    capabilities = {torch.device("cuda:1"): capability}
    monkeypatch.setattr(torch.cuda, "get_device_capability", capabilities.__getitem__)
    assert build.choose_precision("auto", torch.device("cuda:1")) == precision


def test_a_gpu_is_asked_for_bits_that_repeat_and_for_all_of_float32(
    tiny: Callable[..., Config], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What comes of it, only a GPU shows: tests/learning/test_on_a_gpu.py."""
    monkeypatch.setattr(torch.backends.cudnn, "deterministic", False)
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", True)
    set_up_torch(tiny(), "cpu")
    assert (torch.backends.cudnn.deterministic, torch.backends.cudnn.allow_tf32) == (True, False)


@pytest.mark.parametrize(("capacity", "size"), [(120, 40), (70_000, 84)])
def test_the_least_bytes_of_a_replay_memory_are_those_it_needs(
    tiny: Callable[..., Config], capacity: int, size: int
) -> None:
    def config(most: int) -> Config:
        return tiny(f"replay.capacity={capacity}", f"env.size={size}", f"replay.max_bytes={most}")

    least = max(2**20, 23 * capacity + 9 * (size**2 + size**2 // 255 + 16))
    build_memory(config(least))
    if least > 2**20:
        with pytest.raises(ConfigError, match=rf"^replay.max_bytes={least - 1}: should be at least {least}, for the"):
            config(least - 1)
        with pytest.raises(ValueError, match="does not hold"):
            ReplayMemory(capacity, (size, size), budget_bytes=least - 1)


def test_dropout_draws_on_the_device_where_its_network_is(
    tiny: Callable[..., Config], monkeypatch: pytest.MonkeyPatch
) -> None:
    seeded: list[str] = []
    monkeypatch.setattr(build, "seed_dropout", lambda network, _: seeded.append(next(network.parameters()).device.type))
    for device in (None, torch.device("meta")):
        build.build_network(tiny("model=resnet"), "network", device)
    assert seeded == ["cpu", "meta"]


def test_a_network_plays_without_what_it_was_learned_by() -> None:
    """An optimizer imports torch._dynamo, which takes as long as torch itself."""
    code = (
        "import sys; from pathlib import Path; "
        "from atlantis_exp.sessions.cards import build_exported_actor, read_card; "
        "card, weights = read_card(Path('pretrained/cnn_fast')); "
        "build_exported_actor(card.config, weights, 'cpu'); print('torch._dynamo' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


def test_emulators_share_the_cores_where_the_system_does_not_say_which_are_ours(
    tiny: Callable[..., Config], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on macOS."""
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.delattr(os, "sched_setaffinity")
    with make_emulators(make_emulator(tiny().env), 3, 2) as emulators:
        assert isinstance(emulators, ProcessEmulators)
        assert len(emulators._processes) == 2
        emulators.reset(range(3), [0, 1, 2])


@pytest.mark.parametrize(
    ("asked", "cores", "workers"), [("null", 128, 4), ("null", 4, 3), ("null", 2, 1), ("null", 1, 1), ("2", 2, 2)]
)
def test_an_evaluation_leaves_a_core_to_the_network(
    tiny: Callable[..., Config], asked: str, cores: int, workers: int
) -> None:
    config = tiny("evaluation.num_envs=4", f"env.workers={asked}")
    with build_evaluator(config.env, config.evaluation, cores).make_emulators(4) as emulators:
        assert isinstance(emulators, ProcessEmulators)
        assert len(emulators._processes) == workers


def test_a_network_with_a_memory_is_not_compiled(tiny: Callable[..., Config]) -> None:
    import_components(tiny("model=cnn", "compile=true"))
    for refused in (import_components, build_learner):  # a training calls the first before it writes anything
        with pytest.raises(ConfigError, match="compile=true: model=cnn_gru has a memory"):
            refused(tiny("model=cnn_gru", "compile=true"))


def test_a_network_with_a_memory_acts_is_watched_and_is_evaluated_with_it(
    tiny: Callable[..., Config], started: Callable[[Config, Path], Trainer], tmp_path: Path
) -> None:
    config = tiny("model=cnn_gru", "model.units=6", "model.burn_in=3", "objective.n_step=2", "training.ema=50")
    trainer = started(config, tmp_path)
    actor, learner = trainer.actor, trainer.learner
    (watched,) = cast("partial[object]", trainer.recorder.play).args
    assert isinstance(actor, RecurrentGreedy)
    assert isinstance(watched, RecurrentGreedy)
    assert isinstance(learner, RecurrentLearner)
    assert (actor.step, watched.step) == (learner.step, learner.evaluated_step)
    assert (actor.units, watched.units, trainer.stack.memory.shape) == (6, 6, (1, 6))
    assert trainer.plan.window == (3, 20, 2) == (3, 20, learner._ahead)
    weights = safetensors.torch.save(learner.network.state_dict())
    assert isinstance(build_network_actor(config, weights, "cpu"), RecurrentGreedy)
