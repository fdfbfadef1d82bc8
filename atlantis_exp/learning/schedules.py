"""Epsilon as a function of progress, the share of the training that is over: 0 at its start, 1 at its planned end."""

import math
from dataclasses import dataclass
from typing import Protocol


class Schedule(Protocol):
    """A value at every progress >= 0, after so many steps; progress exceeds 1 when a training is prolonged."""

    def __call__(self, progress: float, steps: int) -> float: ...


@dataclass(frozen=True)
class ConstantEpsilon:
    """The same epsilon throughout."""

    value: float

    def __call__(self, progress: float, steps: int) -> float:  # noqa: ARG002
        return self.value


@dataclass(frozen=True)
class LinearEpsilon:
    """Epsilon on a straight line from `start` to `end` over the first `duration` of the training, then `end`."""

    start: float
    end: float
    duration: float  # share of the training

    def __call__(self, progress: float, steps: int) -> float:  # noqa: ARG002
        remaining = max(0.0, 1.0 - progress / self.duration)
        return self.end + (self.start - self.end) * remaining


@dataclass(frozen=True)
class LinearStepsEpsilon:
    """Epsilon on a straight line from `start` to `end` over the first `steps`, however long the training is."""

    start: float
    end: float
    steps: int

    def __call__(self, progress: float, steps: int) -> float:  # noqa: ARG002
        return LinearEpsilon(self.start, self.end, self.steps)(steps, steps)


@dataclass(frozen=True)
class ExponentialEpsilon:
    """Epsilon whose distance to `end` shrinks by a factor e per `decay` and never quite vanishes (report figure 4.1).

    The report decays from 0.9 to 0.02 by episode with half its number of episodes as constant: `decay` 0.5.
    """

    start: float
    end: float
    decay: float  # share of the training

    def __call__(self, progress: float, steps: int) -> float:  # noqa: ARG002
        return self.end + (self.start - self.end) * math.exp(-progress / self.decay)
