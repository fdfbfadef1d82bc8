import csv
import io
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from atlantis_exp.build import build_learner, make_emulator
from atlantis_exp.components import facts_of, game_of
from atlantis_exp.config import Config
from atlantis_exp.game.vector import Emulators, make_emulators
from atlantis_exp.training.actor import (
    NO_MEMORY,
    Actor,
    Decisions,
    EpsilonGreedy,
    Generators,
    Memory,
    RandomActor,
    RecurrentGreedy,
    States,
    Values,
)
from atlantis_exp.training.evaluation import Episode, Evaluation, evaluate

Compose = Callable[..., Config]

GAME = replace(facts_of(game_of("Atlantis-v0")), sources=())


@pytest.fixture
def played(tiny: Compose) -> Callable[..., Evaluation]:
    def play(num_envs: int, actor: Actor | None = None, **chosen: float) -> Evaluation:
        env = tiny("env.max_steps=25").env
        settings = {"episodes": 4, "epsilon": 0.5, "seed": 5, "size": env.size, "lags": env.lags, **chosen}
        with make_emulators(make_emulator(env), num_envs, workers=0) as emulators:
            return evaluate(actor or RandomActor(4), emulators, **settings)  # type: ignore[arg-type]

    return play


def test_an_episode_depends_on_the_seed_and_its_index_alone(played: Callable[..., Evaluation]) -> None:
    alone = played(1)
    assert played(3) == alone
    assert played(1, episodes=2).episodes == alone.episodes[:2]
    assert played(1, episodes=2, seed=6).episodes[0].seed != alone.episodes[0].seed
    actions = {bytes(episode.actions) for episode in alone.episodes}
    assert len(actions) == 4
    assert all(episode.steps == 25 and episode.truncated for episode in alone.episodes)


def test_an_episode_begins_without_a_memory_and_keeps_its_own(played: Callable[..., Evaluation]) -> None:
    def step(_: States, memory: Memory) -> tuple[Values, Memory]:
        return np.eye(4, dtype=np.float32)[memory[:, 0].astype(int) % 4], memory + 1

    for num_envs in (1, 3, 4):
        evaluation = played(num_envs, RecurrentGreedy(1, step, 4), epsilon=0.0)
        assert [[*episode.actions] for episode in evaluation.episodes] == [[each % 4 for each in range(25)]] * 4


@pytest.mark.slow
def test_a_network_evaluated_twice_plays_twice_the_same(tiny: Compose, played: Callable[..., Evaluation]) -> None:
    learner = build_learner(tiny())
    actor = EpsilonGreedy(learner.q_values, 4)
    generators = {name: stream.get_state() for name, stream in learner._generators().items()}
    first, second = played(2, actor), played(2, actor)
    assert first == second
    assert 0.3 < first.random_share < 0.7
    assert played(2, actor, epsilon=0.0).random_share == 0.0
    for name, stream in learner._generators().items():
        assert stream.get_state().equal(generators[name])


def test_more_environments_than_episodes_play_each_episode_once(played: Callable[..., Evaluation]) -> None:
    told: list[tuple[list[int], int]] = []
    play = partial(
        played,
        on_step=lambda episodes: told.append(([each.steps for each in episodes], sum(each.over for each in episodes))),
    )
    assert len({episode.seed for episode in play(3, episodes=2).episodes}) == 2
    steps = [[step, step - behind] for step in range(1, 26) for behind in (1, 0)]
    assert told == [(each, each.count(25)) for each in steps]
    told.clear()
    play(1, episodes=2)
    assert told == [([min(step, 25), max(step - 25, 0)], step // 25) for step in range(1, 51)]


def test_the_actor_decides_for_one_half_while_the_other_is_emulated(
    tiny: Compose, monkeypatch: pytest.MonkeyPatch
) -> None:
    tape: list[str] = []

    class Watched(RandomActor):
        def act(self, states: States, epsilon: float, generators: Generators, memory: Memory = NO_MEMORY) -> Decisions:
            tape.append(f"decide {len(states)}")
            return super().act(states, epsilon, generators, memory)

    def watch(emulators: Emulators, name: str) -> None:
        called = getattr(emulators, name)

        def watched(*given: object) -> object:
            tape.append(name)
            return called(*given)

        monkeypatch.setattr(emulators, name, watched)

    env = tiny("env.max_steps=3").env
    with make_emulators(make_emulator(env), 5, workers=0) as emulators:
        watch(emulators, "reset")
        watch(emulators, "send")
        watch(emulators, "receive")
        evaluate(Watched(4), emulators, episodes=6, epsilon=0.5, seed=5, size=env.size, lags=env.lags)
    next_of_three, next_of_two = ["receive", "decide 3", "send"], ["receive", "decide 2", "send"]
    the_sixth_episode = ["receive", "decide 1", "send"]  # on environment 0, while the others have none left
    assert tape == [
        *("reset", "decide 3", "send", "decide 2", "send"),  # all games are loaded at once
        *2 * (next_of_three + next_of_two),
        *("receive", "reset", "decide 1", "send", "receive"),
        *(2 * the_sixth_episode + ["receive"]),
    ]


def test_the_actions_are_counted_by_who_chose_them() -> None:
    evaluation = Evaluation(
        0.1,
        [
            Episode(1, 300.0, 12, False, bytearray([0, 1, 1, 3]), bytearray([1, 0, 0, 0])),
            Episode(2, 900.0, 6, True, bytearray([3, 3]), bytearray([1, 0])),
        ],
        GAME,
    )
    assert evaluation.action_counts.tolist() == [[0, 1], [2, 0], [0, 0], [2, 1]]
    metrics = evaluation.metrics()
    assert metrics["actions/random_share"] == pytest.approx(2 / 6)
    assert metrics["actions/random_share_best"] == 0.5
    assert metrics["actions/LEFTFIRE"] == 0.5
    assert (metrics["evaluation/mean"], metrics["evaluation/truncated_share"]) == (600, 0.5)
    [first, second] = csv.DictReader(io.StringIO(evaluation.table().to_csv()))
    assert (first["score"], first["random"], first["FIRE"], second["truncated"]) == ("300.0", "1", "2", "1")
    assert evaluation.report().endswith("high score: 900.0, rand: 50.0% player: 50.0%")
    evaluation.best.raw_values += bytes(2 * 4 * 4)  # of four actions, at two steps
    assert evaluation.report() == (
        "eval:\n\navg score: 600.0  high score: 900.0  low score: 300.0\n\n"
        "interquartile range (450.0 -> 750.0) mean = 600.00\n\n"
        "high score: 900.0, rand: 50.0% neural net: 50.0%"
    )


def test_what_the_policy_does_is_counted() -> None:
    def episode(actions: list[int], random: list[int], best: list[int]) -> Episode:
        values = bytearray(np.eye(4, dtype=np.float32)[best].tobytes())
        return Episode(1, 0.0, 12, False, bytearray(actions), bytearray(random), raw_values=values)

    evaluation = Evaluation(
        0.5,
        [
            episode([0, 1, 1, 3], [1, 0, 0, 1], best=[0, 1, 1, 0]),
            episode([0, 1, 2, 1], [1, 0, 1, 0], best=[1, 1, 0, 1]),
        ],
        GAME,
    )
    assert evaluation.chance_agreement == 1 / 4
    assert evaluation.favourite == ("FIRE", 1.0)
    assert evaluation.collapsed
    metrics = evaluation.metrics()
    shares = [2 / 8, 4 / 8, 1 / 8, 1 / 8]
    assert metrics["actions/entropy"] == pytest.approx(-sum(share * np.log2(share) for share in shares))
    assert (metrics["actions/favourite_share"], metrics["actions/random_equals_best"]) == (1.0, 0.25)
    assert evaluation.policy == "collapsed: FIRE in 100.0% of the network's decisions"


def test_a_policy_that_still_does_something_else_has_not_collapsed() -> None:
    actions, chosen = bytearray([1] * 99 + [2]), bytearray(100)
    evaluation = Evaluation(0.0, [Episode(1, 0.0, 12, False, actions, chosen)], GAME)
    assert not evaluation.collapsed
    assert evaluation.policy == "FIRE in 99.0% of the network's decisions"
    assert evaluation.chance_agreement is None
    assert "actions/random_equals_best" not in evaluation.metrics()


def test_a_player_without_a_network_has_no_favourite(played: Callable[..., Evaluation]) -> None:
    evaluation = played(1)
    assert evaluation.favourite[1] == 0.0
    assert evaluation.policy == "chance alone"
    assert not evaluation.collapsed


def test_the_score_is_split_by_what_paid_it(tiny: Compose) -> None:
    env = tiny("env.max_steps=700").env
    with make_emulators(make_emulator(env), 2, workers=0) as emulators:
        evaluation = evaluate(RandomActor(4), emulators, episodes=2, epsilon=0.0, seed=5, size=env.size, lags=env.lags)
    emulator = make_emulator(env)()
    sources = emulator.game.sources
    totals = dict.fromkeys(sources, 0.0)
    for episode in evaluation.episodes:
        assert sum(episode.points) == episode.score > 0
        emulator.reset(episode.seed)
        for action in episode.actions:
            for source, points in zip(sources, emulator.step(action).points, strict=True):
                totals[source] += points
    assert min(totals["centre_vessel"], totals["side_vessel"], totals["wave_bonus"]) > 0
    metrics = evaluation.metrics()
    assert {source: 2 * metrics[f"evaluation/score_{source}"] for source in sources} == totals
    assert evaluation.table().points.tolist() == [episode.points for episode in evaluation.episodes]
