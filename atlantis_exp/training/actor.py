"""Choose the next action: players."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

Generators = Sequence[np.random.Generator]
States = npt.NDArray[np.uint8]  # (B, stack, size, size)
Values = npt.NDArray[np.float32]  # (B, actions)
Memory = npt.NDArray[np.float32]  # (B, units)
NO_MEMORY: Memory = np.empty((0, 0), np.float32)


class Decisions(NamedTuple):
    """One action a state, whether chance chose it (the decision source), and the network's values if known."""

    actions: npt.NDArray[np.int64]  # (B,)
    random: npt.NDArray[np.bool_]  # (B,)
    values: Values | None = None


class Actor(Protocol):
    """Choose an action for each of B states; state b draws only from the b-th generator.

    A player whose `units` is not 0 remembers earlier states of an episode: `act` reads `memory` and overwrites it.
    """

    @property
    def units(self) -> int: ...

    def act(self, states: States, epsilon: float, generators: Generators, memory: Memory) -> Decisions: ...


@dataclass(frozen=True)
class EpsilonGreedy:
    """Choose the network's best action, or any action with probability epsilon (report figure 3.2).

    Random decisions skip the network, unless `watches`: then the decisions hold its values of all states.
    """

    units: ClassVar[int] = 0
    q_values: Callable[[States], Values]
    num_actions: int
    watches: bool = False

    def act(self, states: States, epsilon: float, generators: Generators, memory: Memory = NO_MEMORY) -> Decisions:  # noqa: ARG002
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
class RecurrentGreedy:
    """Choose as `EpsilonGreedy` by a network with a memory, which sees every state, random decisions or not.

    step: returns the values of states and the memory after them.
    """

    units: int
    step: Callable[[States, Memory], tuple[Values, Memory]]
    num_actions: int

    def act(self, states: States, epsilon: float, generators: Generators, memory: Memory) -> Decisions:
        values, memory[:] = self.step(states, memory)
        return EpsilonGreedy(lambda _: values, self.num_actions, watches=True).act(states, epsilon, generators)


@dataclass(frozen=True)
class RandomActor:
    """Choose any action, whatever epsilon is (report figure 1.4)."""

    units: ClassVar[int] = 0
    num_actions: int

    def act(self, states: States, epsilon: float, generators: Generators, memory: Memory = NO_MEMORY) -> Decisions:  # noqa: ARG002
        actions = np.array([generator.integers(self.num_actions) for generator in generators], np.int64)
        return Decisions(actions, np.ones(len(states), np.bool_))


@dataclass(frozen=True)
class PersonActor:
    """Let a person `choose` an action from the screen of a single emulator, (210, 160, 3) uint8."""

    units: ClassVar[int] = 0
    screen: Callable[[], npt.NDArray[np.uint8]]
    choose: Callable[[npt.NDArray[np.uint8]], int]

    def act(self, states: States, epsilon: float, generators: Generators, memory: Memory = NO_MEMORY) -> Decisions:  # noqa: ARG002
        return Decisions(np.array([self.choose(self.screen())], np.int64), np.zeros(1, np.bool_))


@dataclass(frozen=True)
class ConstantActor:
    """Choose always the same action, whatever epsilon is."""

    units: ClassVar[int] = 0
    action: int

    def act(self, states: States, epsilon: float, generators: Generators, memory: Memory = NO_MEMORY) -> Decisions:  # noqa: ARG002
        return Decisions(np.full(len(states), self.action, np.int64), np.zeros(len(states), np.bool_))
