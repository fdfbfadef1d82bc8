"""Choose the transitions to learn from."""

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from atlantis_exp.components import Oversample, Probability
from atlantis_exp.faults import Fault
from atlantis_exp.replay.memory import ReplayMemory

_MOST_ERROR = 1e30  # so that the sum of all priorities is finite
_LEAST_ERROR = 1e-6  # added to every error, so that each transition may come again
_MOST_PRIORITY = 2 * _MOST_ERROR
_FOREIGN = "the sampler's priorities do not match the replay memory; resume=never keeps this run and starts over"


class Draw(NamedTuple):
    """A batch's transitions and their weights in the loss, None if all are equal."""

    ids: npt.NDArray[np.int64]  # (B,)
    weights: npt.NDArray[np.float32] | None  # (B,), at most 1


class Sampler(Protocol):
    """Choose the transitions of a batch; after a draw with weights, receive the batch's errors."""

    def sample(self, memory: ReplayMemory, batch_size: int, rng: np.random.Generator) -> Draw:
        """Draw `batch_size` of the available transitions; ValueError if there are none."""

    def feed_back(self, ids: npt.NDArray[np.int64], errors: npt.NDArray[np.float32]) -> None:
        """Note the absolute TD errors (B,) of transitions (B,)."""

    def state_dict(self) -> dict[str, Any]:
        """Return the state that a continued training needs besides the memory."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a state that `state_dict` returned."""


class _Stateless:
    def feed_back(self, ids: npt.NDArray[np.int64], errors: npt.NDArray[np.float32]) -> None:
        pass

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass


@dataclass(frozen=True)
class UniformSampler(_Stateless):
    """Draw available transitions with equal probability."""

    def sample(self, memory: ReplayMemory, batch_size: int, rng: np.random.Generator) -> Draw:
        return Draw(memory.draw(batch_size, rng), None)


@dataclass(frozen=True)
class TopHalfSampler(_Stateless):
    """Draw `oversample` times the batch uniformly, and keep the transitions of highest reward, best first.

    2 is the report's (section 4): "sample twice the specified batch size, sort the samples decreasingly by reward,
    then take only the top half". Ties keep the order of the draw.
    """

    oversample: Oversample

    def sample(self, memory: ReplayMemory, batch_size: int, rng: np.random.Generator) -> Draw:
        ids = memory.draw(self.oversample * batch_size, rng)
        return Draw(ids[np.argsort(-memory.rewards(ids), kind="stable")[:batch_size]], None)


class PrioritizedSampler:
    """Draw transitions in proportion to their last error to the power `alpha` (Schaul et al. 2016).

    Weights correct for that with the power `beta`; the least likely transition of a batch has weight 1. A new
    transition gets the highest priority so far. Draws are stratified: one from each of `batch_size` equal parts of the
    sum of all priorities. Takes 16 to 32 bytes for each observation of the memory's capacity.
    """

    def __init__(self, alpha: Probability, beta: Probability) -> None:
        self.alpha = alpha
        self.beta = beta
        # A binary tree of sums: node n is the sum of 2n and 2n + 1; the second half are leaves, one a slot of the
        # memory's ring. Sums are never updated by differences, so the leaves alone determine all bits.
        self._tree = np.zeros(2)
        self._capacity = 0  # of the memory
        self._highest = 1.0  # priority
        self._oldest_id = 0  # of the memory at the last draw
        self._next_id = 0

    def sample(self, memory: ReplayMemory, batch_size: int, rng: np.random.Generator) -> Draw:
        if not len(memory):
            raise ValueError("replay holds no transition to draw")
        self._look_at(memory)
        slots = self._find((np.arange(batch_size) + rng.random(batch_size)) / batch_size)
        while True:
            ids = memory.oldest_id + (slots - memory.oldest_id) % memory.capacity
            gone = ~memory.available(ids)  # the memory has forgotten part of their first state
            if not gone.any():
                break
            self._set(slots[gone], np.zeros(np.count_nonzero(gone)))
            slots[gone] = self._find(rng.random(np.count_nonzero(gone)))
        priorities = self._leaves[slots]
        return Draw(ids, ((priorities.min() / priorities) ** self.beta).astype(np.float32))

    def feed_back(self, ids: npt.NDArray[np.int64], errors: npt.NDArray[np.float32]) -> None:
        # A priority that is NaN, or an infinite sum, would make `_find` loop forever.
        priorities = (np.minimum(np.nan_to_num(errors.astype(np.float64)), _MOST_ERROR) + _LEAST_ERROR) ** self.alpha
        self._set(ids % self._capacity, priorities)
        self._highest = max(self._highest, float(priorities.max()))

    def state_dict(self) -> dict[str, Any]:
        return {
            "priorities": self._leaves,
            "highest": self._highest,
            "oldest_id": self._oldest_id,
            "next_id": self._next_id,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a state that `state_dict` returned. Raises: ValueError."""
        priorities, highest = state["priorities"], float(state["highest"])
        if priorities.dtype != np.float64 or not np.all((priorities >= 0) & (priorities <= _MOST_PRIORITY)):
            raise ValueError("the sampler's priorities are not all finite and at least 0")
        if not 0 < highest <= _MOST_PRIORITY:
            raise ValueError(f"the sampler's highest priority is {highest}")
        self._plant(priorities)
        self._highest, self._oldest_id, self._next_id = highest, int(state["oldest_id"]), int(state["next_id"])

    @property
    def _leaves(self) -> npt.NDArray[np.float64]:
        half = len(self._tree) // 2
        return self._tree[half : half + self._capacity]

    def _plant(self, priorities: npt.NDArray[np.float64]) -> None:
        self._capacity = len(priorities)
        self._tree = np.zeros(2 << (self._capacity - 1).bit_length())
        self._set(np.arange(self._capacity), priorities)

    def _look_at(self, memory: ReplayMemory) -> None:
        """Drop transitions that the memory has dropped, and add the new ones."""
        if not self._next_id:
            self._plant(np.zeros(memory.capacity))
        if self._capacity != memory.capacity or not 0 <= self._oldest_id <= self._next_id <= memory.next_id:
            raise Fault(_FOREIGN)
        gone = np.arange(self._oldest_id, min(memory.oldest_id, self._oldest_id + memory.capacity))
        self._set(gone % memory.capacity, np.zeros(len(gone)))
        new = memory.completed(self._next_id)
        self._set(new % memory.capacity, np.full(len(new), self._highest))
        self._oldest_id, self._next_id = memory.oldest_id, memory.next_id

    def _set(self, slots: npt.NDArray[np.int64], priorities: npt.NDArray[np.float64]) -> None:
        nodes = slots + len(self._tree) // 2
        self._tree[nodes] = priorities
        while len(nodes) and nodes[0] > 1:
            nodes = np.unique(nodes >> 1)
            self._tree[nodes] = self._tree[2 * nodes] + self._tree[2 * nodes + 1]

    def _find(self, shares: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
        """Return the slots at these shares, in [0, 1), of the sum of all priorities."""
        if not self._tree[1] > 0:  # nothing would ever be found
            raise Fault(_FOREIGN)
        rest = shares * self._tree[1]
        nodes = np.ones(len(shares), np.int64)
        while nodes[0] < len(self._tree) // 2:
            nodes *= 2
            left = self._tree[nodes]
            right = (rest >= left) & (self._tree[nodes + 1] > 0)  # rounding must not lead to nothing
            rest = np.where(right, rest - left, rest)
            nodes += right
        return nodes - len(self._tree) // 2
