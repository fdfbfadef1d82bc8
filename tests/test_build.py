"""What is built from a config, counted."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from atlantis_exp.build import build_emulators, build_evaluator, build_learner
from atlantis_exp.config import Config
from atlantis_exp.game.vector import ProcessEmulators

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
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    with build_emulators(tiny("env.num_envs=3", "env.workers=null").env, 3) as emulators:
        assert isinstance(emulators, ProcessEmulators)
        assert len(emulators._processes) == 2
        emulators.reset(range(3), [0, 1, 2])


@pytest.mark.parametrize(
    ("asked", "cores", "workers"), [("null", 128, 4), ("null", 4, 3), ("null", 2, 1), ("null", 1, 1), ("2", 2, 2)]
)
def test_an_evaluation_leaves_a_core_to_the_network(
    tiny: Callable[..., Config], monkeypatch: pytest.MonkeyPatch, asked: str, cores: int, workers: int
) -> None:
    monkeypatch.setattr("atlantis_exp.build._cores", lambda: cores)
    config = tiny("evaluation.num_envs=4", f"env.workers={asked}")
    with build_evaluator(config.env, config.evaluation).make_emulators(4) as emulators:
        assert isinstance(emulators, ProcessEmulators)
        assert len(emulators._processes) == workers
