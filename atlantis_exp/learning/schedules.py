"""Schedule epsilon, or the learning rate's factor, by progress: 0 at a training's start, 1 at its planned end."""

import math
from dataclasses import dataclass
from typing import Protocol

from atlantis_exp.components import Count, Positive, Probability, Share


class Schedule(Protocol):
    """Return the value at a progress >= 0 and a number of steps; progress exceeds 1 past the last planned episode."""

    def __call__(self, progress: float, steps: int) -> float: ...


@dataclass(frozen=True)
class Constant:
    """The same value throughout."""

    value: Probability

    def __call__(self, progress: float, steps: int) -> float:  # noqa: ARG002
        return self.value


@dataclass(frozen=True)
class Linear:
    """A straight line from `start` to `end` over the first `duration` of the training, then `end`."""

    start: Probability
    end: Probability
    duration: Positive  # share of the training

    def __call__(self, progress: float, steps: int) -> float:  # noqa: ARG002
        remaining = max(0.0, 1.0 - progress / self.duration)
        return self.end + (self.start - self.end) * remaining


@dataclass(frozen=True)
class LinearSteps:
    """A straight line from `start` to `end` over the first `steps`, then `end`, however long the training is."""

    start: Probability
    end: Probability
    steps: Count

    def __call__(self, progress: float, steps: int) -> float:  # noqa: ARG002
        return Linear(self.start, self.end, self.steps)(steps, steps)


@dataclass(frozen=True)
class Exponential:
    """A value whose distance to `end` shrinks by a factor e per `decay` but never vanishes (report figure 4.1).

    The report decays from 0.9 to 0.02 by episode, with half its number of episodes as the constant: `decay` 0.5.
    """

    start: Probability
    end: Probability
    decay: Positive  # share of the training

    def __call__(self, progress: float, steps: int) -> float:  # noqa: ARG002
        return self.end + (self.start - self.end) * math.exp(-progress / self.decay)


@dataclass(frozen=True)
class OneCycle:
    """Up from `start` to 1 over the first `rise` of the training and down to `end` over the rest, each half a cosine.

    Smith and Topin 2018, in the form of torch's `OneCycleLR`.
    """

    start: Probability
    end: Probability
    rise: Share  # share of the training

    def __call__(self, progress: float, steps: int) -> float:  # noqa: ARG002
        if progress < self.rise:
            foot, climbed = self.start, progress / self.rise
        else:
            foot, climbed = self.end, max(0.0, (1.0 - progress) / (1.0 - self.rise))
        return foot + (1.0 - foot) * (1.0 - math.cos(math.pi * climbed)) / 2
