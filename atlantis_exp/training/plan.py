"""Plan a training, and how often to record it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field

from atlantis_exp.learning.schedules import Schedule
from atlantis_exp.replay.memory import ReplayMemory, Returns, Sequences, Transitions, Window
from atlantis_exp.replay.samplers import Sampler
from atlantis_exp.runs.files import checked

Unit = Literal["episodes", "steps"]
Count = Annotated[int, Field(ge=0, lt=2**53)]


@dataclass
class Counters:
    """The training so far, over all sessions."""

    steps: Count = 0
    frames: Count = 0
    episodes: Count = 0
    random: Count = 0  # random decisions
    learn_ticks: Count = 0  # multiples of learn_every that have passed
    seconds: Annotated[float, Field(ge=0, lt=1e12)] = 0.0

    @classmethod
    def of(cls, saved: Mapping[str, Any]) -> Self:
        """Return a checkpoint's counters. Raises: KeyError, TypeError, ValueError."""
        counters = checked(cls, {field.name: saved[field.name] for field in fields(cls)})
        if counters.episodes > counters.steps:
            raise ValueError(f"{counters.episodes} episodes in {counters.steps} steps")
        return counters


@dataclass(frozen=True)
class Phase:
    """A stretch of training with its own learning rate and sampler."""

    name: str
    length: int  # in the plan's unit
    learning_rate: float
    sampler: Sampler


@dataclass(frozen=True)
class Plan:
    """Phases one after the other, all measured in episodes or all in steps."""

    unit: Unit
    phases: Sequence[Phase]
    epsilon: Schedule
    learning_rate: Schedule  # share of the phase's
    returns: Returns
    terminal_on_life_loss: bool  # for the learner; the episode continues
    learn_every: int  # steps
    learn_start: int  # transitions in the memory
    batch_size: int  # transitions, or sequences
    window: Window | None = None  # of the sequences that a network with a memory learns from

    @property
    def length(self) -> int:
        """The length of all phases, in the plan's unit."""
        return sum(phase.length for phase in self.phases)

    def gather(self, memory: ReplayMemory, ids: npt.NDArray[np.int64]) -> Transitions | Sequences:
        """Return what an update learns from. Raises: ValueError if an id is not available."""
        if self.window is None:
            return memory.gather(ids, self.returns)
        return memory.gather_sequences(ids, self.returns, self.window)

    def done(self, counters: Counters) -> int:
        """Return how much of `length` is done."""
        return counters.episodes if self.unit == "episodes" else counters.steps

    def phase_at(self, counters: Counters) -> Phase:
        """Return the current phase; after the plan's end, the last one."""
        done = self.done(counters)
        for phase in self.phases:
            done -= phase.length
            if done < 0:
                return phase
        return self.phases[-1]

    def learning_rate_at(self, counters: Counters) -> float:
        """Return the step size of the next update."""
        share = self.learning_rate(self.done(counters) / self.length, counters.steps)
        return self.phase_at(counters).learning_rate * share

    def epsilon_at(self, counters: Counters) -> float:
        """Return the probability that the next decision is random."""
        # The report counts the current episode: its first has epsilon(1), not epsilon(0).
        running = 1 if self.unit == "episodes" else 0
        return self.epsilon((self.done(counters) + running) / self.length, counters.steps)


@dataclass(frozen=True)
class Cadence:
    """How often to record, evaluate and commit a training; does not influence learning."""

    curve_steps: int  # steps between two points of a curve
    histogram_episodes: int  # episodes in a window's histogram
    commit_episodes: int  # episodes between two commits
    commit_seconds: float  # at most, between two commits
    evaluate_episodes: int | None  # training episodes between two evaluations
    evaluate_steps: int | None  # training steps between two evaluations
    evaluate_at_end: bool
    interim_episodes: int  # of an evaluation during the training
    final_episodes: int  # of the one at its end


def step_of(updates: int, learn_start: int, learn_every: int) -> int:
    """Return the approximate step of an update."""
    return learn_start + updates * learn_every


def passed(every: int | None, before: int, now: int) -> bool:
    """Return whether a multiple of `every` lies in (before, now]; False for None."""
    return every is not None and now // every > before // every
