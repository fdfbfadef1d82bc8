"""Episodes played again from their seeds and actions."""

import io
from array import array
from collections.abc import Callable
from itertools import count
from typing import get_args

import av
import numpy as np
import pytest
from rich.console import Console

from atlantis_exp.build import build_evaluator, build_learner, make_emulator
from atlantis_exp.config import Config
from atlantis_exp.game.preprocessing import FrameStack
from atlantis_exp.game.vector import make_emulators
from atlantis_exp.training.actor import Actor, EpsilonGreedy, RandomActor
from atlantis_exp.training.evaluation import Episode, Stopped, evaluate
from atlantis_exp.training.film import Part, film_episode, moments, span
from atlantis_exp.training.progress import Progress

Compose = Callable[..., Config]


@pytest.fixture
def played(tiny: Compose) -> Callable[..., Episode]:
    def play(actor: Actor | None = None) -> Episode:
        env = tiny("env.max_steps=25").env
        with make_emulators(make_emulator(env), 1, 1) as emulators:
            player = actor or RandomActor(4)
            return evaluate(player, emulators, episodes=4, epsilon=0.5, seed=5, size=env.size, lags=env.lags).best

    return play


def test_an_episode_can_be_seen_again_from_its_seed_and_actions(tiny: Compose, played: Callable[..., Episode]) -> None:
    episode = played()
    emulator = make_emulator(tiny("env.max_steps=25").env)()
    seen = list(moments(episode, emulator))
    assert len(seen) == episode.steps + 1
    assert seen[0].screen.shape == (210, 160, 3)
    assert [moment.action for moment in seen] == [*episode.actions, None]
    assert [moment.random for moment in seen[:-1]] == [bool(chance) for chance in episode.random]
    later = list(moments(episode, emulator, start=20))
    for moment, same in zip(later, seen[20:], strict=True):
        assert np.array_equal(moment.screen, same.screen)
        assert moment[1:5] == same[1:5]
    emulator.reset(episode.seed)
    steps = [emulator.step(action) for action in episode.actions]
    assert sum(step.reward for step in steps) == episode.score == seen[-1].score
    assert sum(step.frames for step in steps) == episode.frames
    assert np.array_equal(seen[-1].screen, emulator.screen_rgb())


def test_the_values_in_a_film_are_those_that_the_network_decided_by(
    tiny: Compose, played: Callable[..., Episode]
) -> None:
    learner = build_learner(tiny())
    episode = played(EpsilonGreedy(learner.q_values, 4, watches=True))
    emulator = make_emulator(tiny("env.max_steps=25").env)()
    filmed = [moment for moment in moments(episode, emulator) if moment.action is not None]
    decided = [moment for moment in filmed if not moment.random]
    assert 0 < len(decided) < len(filmed)
    assert all(moment.q_values is not None for moment in filmed)
    assert [moment.action for moment in decided] == [int(moment.q_values.argmax()) for moment in decided]  # type: ignore[union-attr]
    observations = FrameStack(1, 40)
    observations.reset([0], emulator.reset(episode.seed)[np.newaxis])
    for moment in filmed:
        np.testing.assert_array_equal(learner.q_values(observations.state)[0], moment.q_values)
        assert moment.action is not None
        observations.push(emulator.step(moment.action).observation[np.newaxis])


def test_a_part_of_an_episode_is_a_minute_of_the_game_or_all_of_it() -> None:
    steps = 3_000
    episode = Episode(1, frames=4 * steps, actions=bytearray(steps), rewards=array("f", [0.0] * steps))
    assert span(episode, "all") == (0, steps)
    assert span(episode, "first_minute") == (0, 900)
    assert span(episode, "best_minute") == (0, 900)  # without points
    for step, points in ((150, 900.0), (1_400, 500.0), (2_299, 500.0), (2_300, 200.0)):
        episode.rewards[step] = points
    assert span(episode, "best_minute") == (1_400, 2_300)
    short = Episode(1, frames=400, actions=bytearray(100), rewards=array("f", [0.0] * 100))
    assert {span(short, part) for part in get_args(Part)} == {(0, 100)}


def test_a_film_of_a_part_shows_that_part_and_says_how_far_it_is(tiny: Compose, played: Callable[..., Episode]) -> None:
    episode = played()
    episode.frames = 12 * 3_600 * episode.steps // 60  # so slow a game that a minute has five steps
    told: list[tuple[int, int]] = []
    content = film_episode(
        episode, make_emulator(tiny("env.max_steps=25").env)(), "first_minute", lambda *n: told.append(n)
    )
    assert told == [(index, 5) for index in range(6)]
    with av.open(io.BytesIO(content), "r") as container:
        assert len(list(container.decode(video=0))) == 6


def test_a_film_is_given_up_once_that_is_asked_for(tiny: Compose) -> None:
    config, progress, asked = tiny("env.max_steps=25", "evaluation.video=all"), Progress(Console(quiet=True)), count()
    evaluator = build_evaluator(config.env, config.evaluation, 1)
    played = evaluator(RandomActor(4), 2, progress)
    with pytest.raises(Stopped):
        evaluator.film(played, progress, lambda: next(asked) == 3)
    assert next(asked) == 4
    assert evaluator.film(played, progress)
