"""Players: who chooses the next action, and from what."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

Generators = Sequence[np.random.Generator]
States = npt.NDArray[np.uint8]  # (B, stack, size, size)


class Decisions(NamedTuple):
    """One action a state, whether chance chose it (the decision source), and the network's values if known."""

    actions: npt.NDArray[np.int64]  # (B,)
    random: npt.NDArray[np.bool_]  # (B,)
    values: npt.NDArray[np.float32] | None = None  # (B, actions)


class Actor(Protocol):
    """Chooses an action for each of B states; state b draws from the b-th generator only."""

    def act(self, states: States, epsilon: float, generators: Generators) -> Decisions: ...


@dataclass(frozen=True)
class EpsilonGreedy:
    """The network's best action, or with probability epsilon any action (report figure 3.2).

    Chance decides before the network is asked, unless `watches`: then the decisions hold its values of all states.
    """

    q_values: Callable[[States], npt.NDArray[np.float32]]
    num_actions: int
    watches: bool = False

    def act(self, states: States, epsilon: float, generators: Generators) -> Decisions:
        random = np.array([generator.random() < epsilon for generator in generators])
        actions = np.empty(len(states), np.int64)
        for row in np.flatnonzero(random).tolist():
            actions[row] = generators[row].integers(self.num_actions)
        if self.watches:
            values = self.q_values(states)
            actions[~random] = values.argmax(axis=1)[~random]
            return Decisions(actions, random, values)
        if not random.all():
            actions[~random] = self.q_values(states[~random]).argmax(axis=1)
        return Decisions(actions, random)


@dataclass(frozen=True)
class RandomActor:
    """Any action, whatever epsilon says (report figure 1.4)."""

    num_actions: int

    def act(self, states: States, epsilon: float, generators: Generators) -> Decisions:  # noqa: ARG002
        actions = np.array([generator.integers(self.num_actions) for generator in generators], np.int64)
        return Decisions(actions, np.ones(len(states), np.bool_))


@dataclass(frozen=True)
class PersonActor:
    """A person who `choose`s an action at the sight of the one emulator's screen, (210, 160, 3) uint8."""

    screen: Callable[[], npt.NDArray[np.uint8]]
    choose: Callable[[npt.NDArray[np.uint8]], int]

    def act(self, states: States, epsilon: float, generators: Generators) -> Decisions:  # noqa: ARG002
        return Decisions(np.array([self.choose(self.screen())], np.int64), np.zeros(1, np.bool_))


@dataclass(frozen=True)
class ConstantActor:
    """Always the same action, whatever epsilon says."""

    action: int

    def act(self, states: States, epsilon: float, generators: Generators) -> Decisions:  # noqa: ARG002
        return Decisions(np.full(len(states), self.action, np.int64), np.zeros(len(states), np.bool_))
