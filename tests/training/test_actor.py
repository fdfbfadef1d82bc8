from collections.abc import Iterator
from itertools import count

import numpy as np
import numpy.typing as npt
import pytest

from atlantis_exp.training.actor import (
    ConstantActor,
    EpsilonGreedy,
    Memory,
    RandomActor,
    RecurrentGreedy,
    States,
    Values,
)

STATES = np.zeros((5, 4, 8, 8), np.uint8)


def generators(first: int = 0) -> list[np.random.Generator]:
    return [np.random.default_rng(first + row) for row in range(len(STATES))]


def values_of(states: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """The best action is the brightness of the state's first pixel."""
    return np.eye(4, dtype=np.float32)[states[:, 0, 0, 0]]


def test_without_chance_the_actor_takes_the_best_action_of_every_state() -> None:
    states = STATES.copy()
    states[:, 0, 0, 0] = [3, 0, 2, 1, 3]
    decisions = EpsilonGreedy(values_of, 4).act(states, 0.0, generators())
    assert decisions.actions.tolist() == [3, 0, 2, 1, 3]
    assert not decisions.random.any()


def test_the_network_is_asked_once_and_only_about_states_that_chance_leaves_to_it() -> None:
    asked: list[int] = []

    def q_values(states: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
        asked.append(len(states))
        return values_of(states)

    actor, streams = EpsilonGreedy(q_values, 4), generators()
    for epsilon in (1.0, *[0.5] * 20):
        random = actor.act(STATES, epsilon, streams).random
        assert ([] if random.all() else [len(STATES) - random.sum()]) == asked
        asked.clear()


def test_an_actor_that_watches_decides_the_same_and_holds_what_the_network_thought() -> None:
    states = STATES.copy()
    states[:, 0, 0, 0] = [3, 0, 2, 1, 3]
    streams, twins = generators(), generators()
    for _ in range(20):
        decisions = EpsilonGreedy(values_of, 4, watches=True).act(states, 0.5, streams)
        expected = EpsilonGreedy(values_of, 4).act(states, 0.5, twins)
        assert decisions.actions.tolist() == expected.actions.tolist()
        assert decisions.random.tolist() == expected.random.tolist()
        assert decisions.values is not None
        assert decisions.values.argmax(axis=1).tolist() == [3, 0, 2, 1, 3]


@pytest.mark.parametrize("epsilon", [0.05, 0.5])
def test_chance_decides_with_probability_epsilon_and_then_takes_every_action_alike(epsilon: float) -> None:
    actor, streams = EpsilonGreedy(values_of, 4), generators()
    decisions = [actor.act(STATES, epsilon, streams) for _ in range(4_000)]
    random = np.concatenate([decision.random for decision in decisions])
    actions = np.concatenate([decision.actions for decision in decisions])
    deviation = np.sqrt(epsilon * (1 - epsilon) / random.size)
    assert abs(random.mean() - epsilon) < 4 * deviation
    shares = np.bincount(actions[random], minlength=4) / random.sum()
    assert np.abs(shares - 0.25).max() < 4 * np.sqrt(0.25 * 0.75 / random.sum())
    assert not actions[~random].any()


def test_what_a_state_gets_depends_on_its_own_generator_alone() -> None:
    actor = EpsilonGreedy(values_of, 4)
    together = [actor.act(STATES, 0.5, streams) for streams in _same(generators())]
    for row in range(len(STATES)):
        alone = [actor.act(STATES[:1], 0.5, streams) for streams in _same([np.random.default_rng(row)])]
        assert [decision.actions[row] for decision in together] == [decision.actions[0] for decision in alone]


def test_players_without_a_network_leave_epsilon_alone() -> None:
    assert RandomActor(4).act(STATES, 0.0, generators()).random.all()
    assert set(RandomActor(4).act(np.zeros((100, 1), np.uint8), 0.0, [np.random.default_rng(0)] * 100).actions) == {
        0,
        1,
        2,
        3,
    }
    decisions = ConstantActor(2).act(STATES, 1.0, generators())
    assert decisions.actions.tolist() == [2] * 5
    assert not decisions.random.any()


def _same(streams: list[np.random.Generator]) -> Iterator[list[np.random.Generator]]:
    for step in count():
        if step == 50:
            return
        yield streams


def test_a_player_with_a_memory_sees_every_state_and_decides_as_one_without() -> None:
    def step(states: States, memory: Memory) -> tuple[Values, Memory]:
        return values_of(states), memory + len(states)

    memory = np.zeros((len(STATES), 2), np.float32)
    decisions = RecurrentGreedy(2, step, 4).act(STATES, 0.5, generators(), memory)
    expected = EpsilonGreedy(values_of, 4, watches=True).act(STATES, 0.5, generators())
    for ours, theirs in zip(decisions, expected, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert decisions.random.any()
    np.testing.assert_array_equal(memory, len(STATES))
