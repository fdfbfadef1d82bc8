"""A sampler: prefer transitions with a reward other than zero."""

from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from annotated_types import Interval

from atlantis_exp.components import component
from atlantis_exp.replay.memory import ReplayMemory
from atlantis_exp.replay.samplers import Draw


@component("paying", "sampler")
class PayingSampler:
    """For each place of a batch draw `tries` times; take the first transition with a reward, else the last."""

    def __init__(self, *, tries: Annotated[int, Interval(ge=1, le=16)] = 2) -> None:
        self.tries = tries

    def sample(self, memory: ReplayMemory, batch_size: int, rng: np.random.Generator) -> Draw:
        ids = memory.draw(batch_size, rng)
        for _ in range(self.tries - 1):
            ids = np.where(memory.rewards(ids) != 0, ids, memory.draw(batch_size, rng))
        return Draw(ids, None)  # with weights, `feed_back` would get the errors of each batch

    def feed_back(self, ids: npt.NDArray[np.int64], errors: npt.NDArray[np.float32]) -> None:
        pass

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass
