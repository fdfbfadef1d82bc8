"""Which transitions to learn from."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from atlantis_exp.replay.memory import ReplayMemory


class Sampler(Protocol):
    """Chooses the ids of a batch."""

    def sample(self, memory: ReplayMemory, batch_size: int, rng: np.random.Generator) -> npt.NDArray[np.int64]:
        """Return `batch_size` ids of available transitions; ValueError if there are none."""


@dataclass(frozen=True)
class UniformSampler:
    """Every available transition is as likely as any other."""

    def sample(self, memory: ReplayMemory, batch_size: int, rng: np.random.Generator) -> npt.NDArray[np.int64]:
        """Return `batch_size` ids drawn uniformly with replacement; ValueError if there are none."""
        return memory.draw(batch_size, rng)


@dataclass(frozen=True)
class TopHalfSampler:
    """Of `oversample` times the batch drawn uniformly, the transitions of highest reward, best first.

    With 2, the report's (section 4): "sample twice the specified batch size, sort the samples decreasingly by reward,
    then take only the top half". Of equal rewards the one drawn earlier comes first.
    """

    oversample: int = 2

    def sample(self, memory: ReplayMemory, batch_size: int, rng: np.random.Generator) -> npt.NDArray[np.int64]:
        """Return `batch_size` ids, chosen by their rewards alone; ValueError if there are none."""
        ids = memory.draw(self.oversample * batch_size, rng)
        return ids[np.argsort(-memory.rewards(ids), kind="stable")[:batch_size]]
