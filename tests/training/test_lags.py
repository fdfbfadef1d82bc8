"""States with gaps and networks with a memory, and a task that is not solved without one of them.

A light shows which action pays many steps later.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pytest
import torch
from rich.console import Console

from atlantis_exp.game.emulator import Step
from atlantis_exp.learning.schedules import Constant
from atlantis_exp.replay.memory import Returns, Window
from atlantis_exp.replay.samplers import UniformSampler
from atlantis_exp.training.actor import Decisions
from atlantis_exp.training.plan import Phase
from atlantis_exp.training.progress import Progress
from atlantis_exp.training.trainer import Trainer
from tests.training.conftest import SIZE, Game, Remembering

LIT = 2  # step of an episode


class Cue(Game):
    """Dark but for a light on the left or the right, and a line at the top where the choice is due."""

    due = 22  # step

    def reset(self, seed: int | None = None) -> npt.NDArray[np.uint8]:
        if seed is not None:
            self.generator = np.random.default_rng(seed)
        self.played, self.pays = 0, int(self.generator.integers(2))
        return self.screen()

    def step(self, action: int) -> Step:
        over = self.played == self.due
        reward = float(over and action == self.pays)
        self.played += 1
        return Step(self.screen(), reward, over, False, False, 4, [reward, 0.0, 0.0, 0.0, 0.0])

    def screen(self) -> npt.NDArray[np.uint8]:
        screen = np.zeros((2, SIZE, SIZE // 2), np.uint8)
        screen[self.pays] = 255 * (self.played == LIT)
        screen[:, 0] = np.maximum(screen[:, 0], 255 * (self.played == self.due))
        return np.hstack([*screen])

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "pays": self.pays}


class SoonDue(Cue):
    due = 8


@pytest.mark.parametrize(
    ("game", "lags", "remembers", "is_solved"),
    [
        (Cue, (0, 1, 2, 20), False, True),
        pytest.param(SoonDue, range(4), False, False, marks=pytest.mark.slow),
        (SoonDue, (0,), True, True),
    ],
)
def test_a_state_that_reaches_back_to_the_light_or_a_memory_solves_what_four_observations_cannot(
    small: Callable[..., Trainer],
    tmp_path: Path,
    game: type[Game],
    lags: Sequence[int],
    remembers: bool,
    is_solved: bool,
) -> None:
    steps, rate = (1_600, 1e-2) if remembers else (4_000, 1e-3)
    trainer = small(
        tmp_path,
        num_envs=4,
        game=game,
        lags=lags,
        remembers=remembers,
        capacity=4_000,
        phases=[Phase("quick", steps, rate, UniformSampler())],
        epsilon=Constant(1.0),
        returns=Returns(0.0),
        batch_size=32,
        evaluate_steps=None,
        evaluate_at_end=False,
    )
    assert trainer.run() == "finished"
    share = trainer.recorder.play(100, Progress(Console(quiet=True)), lambda: False).summary.mean
    assert share > 0.9 if is_solved else 0.3 < share < 0.7


def test_a_state_is_the_same_where_it_is_acted_on_and_where_it_is_learned_from(
    small: Callable[..., Trainer], tmp_path: Path
) -> None:
    trainer = small(tmp_path, num_envs=2, lags=(0, 3, 7), capacity=1_000, evaluate_steps=None)
    acted, act = [], trainer.actor.act

    def watched(states: npt.NDArray[np.uint8], *asked: Any) -> Decisions:
        acted.append(states)
        return act(states, *asked)

    trainer.actor = SimpleNamespace(act=watched)
    trainer.run()
    ids = np.arange(trainer.memory.next_id)
    learned = trainer.memory.gather(ids[trainer.memory.available(ids)], Returns(0.9, n_step=5))
    np.testing.assert_array_equal(learned.s_t, np.concatenate(acted))
    assert len(learned.s_t) == 160  # in episodes of 40 steps


def test_a_memory_acts_in_training_as_the_network_does_over_the_whole_episode(
    small: Callable[..., Trainer], tmp_path: Path
) -> None:
    trainer = small(tmp_path, num_envs=2, remembers=True, learn_start=10_000, epsilon=Constant(0.5), capacity=1_000)
    acted, act = [], trainer.actor.act

    def watched(*asked: Any) -> Decisions:
        acted.append(act(*asked))
        return acted[-1]

    trainer.actor = SimpleNamespace(act=watched, units=Remembering.units)
    trainer.run()
    last_states = trainer.memory.next_id - np.array([6, 5])  # then come the last observations and new episodes
    whole = trainer.memory.gather_sequences(last_states, Returns(0.9), Window(39, 1, 0))
    x, nothing = torch.from_numpy(whole.states) / 255, torch.zeros(2, Remembering.units)
    q, _ = cast(Remembering, trainer.learner.network).sequence(x, nothing, torch.from_numpy(whole.first))
    played = np.stack([each.values for each in acted[-40:] if each.values is not None], 1)
    np.testing.assert_allclose(q.detach(), played, atol=1e-5)
