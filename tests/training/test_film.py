"""Episodes played again from their seeds and actions."""

from collections.abc import Callable

import numpy as np
import pytest

from atlantis_exp.build import build_emulators, build_learner, make_emulator
from atlantis_exp.config import Config
from atlantis_exp.training.actor import Actor, EpsilonGreedy, RandomActor
from atlantis_exp.training.evaluation import Episode, evaluate
from atlantis_exp.training.film import moments

Compose = Callable[..., Config]


@pytest.fixture
def played(tiny: Compose) -> Callable[..., Episode]:
    def play(actor: Actor | None = None) -> Episode:
        env = tiny("env.max_steps=25").env
        with build_emulators(env, 1) as emulators:
            player = actor or RandomActor(4)
            return evaluate(player, emulators, episodes=4, epsilon=0.5, seed=5, size=env.size, stack=env.stack).best

    return play


def test_an_episode_can_be_seen_again_from_its_seed_and_actions(tiny: Compose, played: Callable[..., Episode]) -> None:
    episode = played()
    emulator = make_emulator(tiny("env.max_steps=25").env)()
    seen = list(moments(episode, emulator, stack=4))
    assert len(seen) == episode.steps + 1
    assert seen[0].screen.shape == (210, 160, 3)
    assert [moment.action for moment in seen] == [*episode.actions, None]
    assert [moment.random for moment in seen[:-1]] == [bool(chance) for chance in episode.random]
    emulator.reset(episode.seed)
    steps = [emulator.step(action) for action in episode.actions]
    assert sum(step.reward for step in steps) == episode.score == seen[-1].score
    assert sum(step.frames for step in steps) == episode.frames
    assert np.array_equal(seen[-1].screen, emulator.screen_rgb())


def test_the_values_beside_a_film_are_those_that_the_network_decided_by(
    tiny: Compose, played: Callable[..., Episode]
) -> None:
    learner = build_learner(tiny())
    episode = played(EpsilonGreedy(learner.q_values, 4))
    emulator = make_emulator(tiny("env.max_steps=25").env)()
    asked = [moment for moment in moments(episode, emulator, 4, learner.q_values) if moment.action is not None]
    decided = [moment for moment in asked if not moment.random]
    assert 0 < len(decided) < len(asked)
    assert all(moment.q_values is not None for moment in asked)
    assert [moment.action for moment in decided] == [int(moment.q_values.argmax()) for moment in decided]  # type: ignore[union-attr]
