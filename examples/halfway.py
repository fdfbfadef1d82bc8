"""A schedule for epsilon or the learning rate: switch from one value to another halfway."""

from dataclasses import dataclass

from atlantis_exp.components import Probability, component


@component("halfway", "epsilon", "lr_schedule")
@dataclass(frozen=True)
class HalfwaySchedule:
    start: Probability = 1.0
    end: Probability = 0.1

    def __call__(self, progress: float, steps: int) -> float:
        return self.start if progress < 0.5 else self.end
