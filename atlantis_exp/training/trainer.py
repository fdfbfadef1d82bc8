"""Run the training loop (report figure 3.1)."""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch

from atlantis_exp.game.preprocessing import FrameStack
from atlantis_exp.game.vector import Emulators, Steps
from atlantis_exp.learning.learner import Learner
from atlantis_exp.replay.memory import ReplayMemory
from atlantis_exp.replay.samplers import Draw, Sampler
from atlantis_exp.training.actor import Actor, Decisions
from atlantis_exp.training.checkpoint import Checkpoints
from atlantis_exp.training.plan import Counters, Plan, passed, step_of
from atlantis_exp.training.recorder import Played, Recorder

Outcome = Literal["finished", "budget", "interrupted"]


@dataclass(kw_only=True, eq=False)
class Trainer:
    """Train one run until the plan, the budget or a stop request ends it.

    With one environment the loop is the report's. With several, due updates run while the emulators play; the result
    never depends on timing.
    """

    plan: Plan
    emulators: Emulators
    stack: FrameStack
    actor: Actor
    memory: ReplayMemory
    learner: Learner
    exploration: Sequence[np.random.Generator]  # one per environment
    sampling: np.random.Generator
    seeds: Sequence[int]  # of the first episodes
    recorder: Recorder
    checkpoints: Checkpoints
    max_steps: int | None
    max_flops: float | None = None

    def __post_init__(self) -> None:
        self.counters = Counters()
        self.scores = np.zeros(self.emulators.num_envs)  # of the current episodes
        self.lengths = np.zeros(self.emulators.num_envs, np.int64)  # of the current episodes, steps
        self._errors: list[tuple[Sampler, npt.NDArray[np.int64], torch.Tensor]] = []  # of updates since the feedback

    def run(self, stop: Callable[[], bool] = lambda: False) -> Outcome:
        """Train on from the counters, and commit; after an error the last commit stays.

        Raises:
            Diverged: the loss is not finite.
            WorkerDied: an emulator's process has died or hangs.
            OSError: a commit cannot be written.
        """
        overlap = self.emulators.num_envs > 1  # learn while they play
        self.emulators.stop = stop
        self._begin(stop)
        while not self.has_ended and not stop():
            sampler = self.plan.phase_at(self.counters).sampler
            self.learner.learning_rate = self.plan.learning_rate_at(self.counters)
            epsilon = self.plan.epsilon_at(self.counters)
            decisions = self.actor.act(self.stack.state, epsilon, self.exploration, self.stack.memory)
            self.emulators.send(decisions.actions)
            if not overlap:
                steps = self._observe(decisions)
            for ids, weights in self._due_batches(sampler):
                errors = self.learner.update(*self.plan.gather(self.memory, ids), weights=weights)
                if weights is not None:
                    self._errors.append((sampler, ids, errors))
            if overlap:
                steps = self._observe(decisions)
            self._record(steps, stop)
        return self._end(stop)

    def commit(self) -> None:
        """Make the checkpoint and all metrics up to it durable together, then visible."""
        self._take_time()
        self.recorder.refuse_divergence()
        self.checkpoints.save(self.state_dict(), self.memory)
        self.recorder.journal.commit()
        self._last_commit = time.monotonic()

    def state_dict(self) -> dict[str, Any]:
        self._feed_back()  # as at the next update, since nothing is drawn before it
        return {
            "counters": asdict(self.counters),
            "learner": self.learner.state_dict(),
            "emulators": self.emulators.state_dict(),
            "stack": self.stack.state_dict(),
            "exploration": [generator.bit_generator.state for generator in self.exploration],
            "sampling": self.sampling.bit_generator.state,
            "samplers": {str(index): phase.sampler.state_dict() for index, phase in enumerate(self.plan.phases)},
            "scores": self.scores,
            "lengths": self.lengths,
            **self.recorder.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.counters = Counters.of(state["counters"])
        due = self.counters.steps // self.plan.learn_every - self.counters.learn_ticks
        if not 0 <= due <= self.emulators.num_envs:  # the next step would make all these updates
            raise ValueError(f"{due} updates are due")
        if self.memory.highest_action >= len(self.emulators.game.actions):
            raise ValueError(f"the replay memory holds action {self.memory.highest_action}, which the game lacks")
        self.learner.load_state_dict(state["learner"])
        self.emulators.load_state_dict(state["emulators"])
        self.stack.load_state_dict(state["stack"])
        for generator, generator_state in zip(self.exploration, state["exploration"], strict=True):
            generator.bit_generator.state = generator_state
        self.sampling.bit_generator.state = state["sampling"]
        for index, phase in enumerate(self.plan.phases):
            phase.sampler.load_state_dict(state["samplers"][str(index)])
        self.scores[:], self.lengths[:] = state["scores"], state["lengths"]
        if not np.isfinite(self.scores).all():
            raise ValueError("the scores are not finite")
        self.recorder.load_state_dict(state)
        for env in range(self.emulators.num_envs):
            if not self.memory.is_under_way(env):  # the episode's start was lost
                self.memory.begin(env, self.stack.state[env, -1])

    @cached_property
    def flops_per_update(self) -> int:
        """Floating-point operations of one update."""
        _, stack, height, width = self.stack.state.shape
        return self.learner.update_flops((stack, height, width), self.plan.batch_size)

    @cached_property
    def max_updates(self) -> int | None:
        """The fewest updates that cost `max_flops`."""
        return None if self.max_flops is None else -(-math.ceil(self.max_flops) // self.flops_per_update)

    @property
    def has_ended(self) -> bool:
        """Whether the plan or the budget is used up."""
        return (
            (self.max_steps is not None and self.counters.steps >= self.max_steps)
            or (self.max_updates is not None and self.learner.updates >= self.max_updates)
            or self.plan.done(self.counters) >= self.plan.length
        )

    @property
    def last_step(self) -> int | None:
        """The approximate step at which the budget will end the training; None without a budget."""
        plan, steps = self.plan, [] if self.max_steps is None else [self.max_steps]
        if self.max_updates is not None:
            steps.append(step_of(self.max_updates, plan.learn_start, plan.learn_every))
        return min(steps, default=None)

    def _begin(self, stop: Callable[[], bool]) -> None:
        if self.memory.next_id == 0:
            self._begin_episodes(range(self.emulators.num_envs), self.seeds)
        self._session_start = time.monotonic() - self.counters.seconds
        self._last_commit = time.monotonic()
        self.recorder.begin(self.counters, self.last_step)
        if self.recorder.done.owes_evaluation:
            self._evaluate(stop)

    def _begin_episodes(self, envs: Sequence[int], seeds: Sequence[int] | None = None) -> None:
        observations = self.emulators.reset(envs, seeds)
        self.stack.reset(envs, observations)
        for row, env in enumerate(envs):
            self.memory.begin(env, observations[row])

    def _due_batches(self, sampler: Sampler) -> Iterator[Draw]:
        """Draw a batch for each due update."""
        due = self.counters.steps // self.plan.learn_every - self.counters.learn_ticks
        self.counters.learn_ticks += due
        if len(self.memory) <= self.plan.learn_start:
            return
        self._feed_back()
        for _ in range(due):
            yield sampler.sample(self.memory, self.plan.batch_size, self.sampling)

    def _feed_back(self) -> None:
        """Report earlier TD errors to their samplers; may wait for the device."""
        for sampler, ids, errors in self._errors:
            sampler.feed_back(ids, errors.cpu().numpy())
        self._errors.clear()

    def _observe(self, decisions: Decisions) -> Steps:
        """Wait for the emulators and store their step."""
        steps = self.emulators.receive()
        self.stack.push(steps.observations)
        terminal = steps.terminated | (steps.life_lost & self.plan.terminal_on_life_loss)
        for env in range(self.emulators.num_envs):
            action, reward = int(decisions.actions[env]), float(steps.rewards[env])
            self.memory.add(env, action, reward, steps.observations[env], bool(terminal[env]))
        self.counters.steps += self.emulators.num_envs
        self.counters.frames += int(steps.frames.sum())
        self.counters.random += int(decisions.random.sum())
        self.scores += steps.rewards
        self.lengths += 1
        return steps

    def _record(self, steps: Steps, stop: Callable[[], bool]) -> None:
        """Start new episodes for ended ones; record, evaluate and commit if due."""
        counters, cadence = self.counters, self.recorder.cadence
        steps_before, episodes_before = counters.steps - self.emulators.num_envs, counters.episodes
        for env in np.flatnonzero(steps.terminated | steps.truncated).tolist():
            counters.episodes += 1
            score, length = float(self.scores[env]), int(self.lengths[env])
            self.recorder.episode(Played(counters.episodes, counters.steps, counters.frames, score, length, env))
            self.scores[env], self.lengths[env] = 0.0, 0
            self._begin_episodes([env])
        if passed(cadence.curve_steps, steps_before, counters.steps):
            self.recorder.curves(counters)
        if passed(cadence.evaluate_steps, steps_before, counters.steps) or passed(
            cadence.evaluate_episodes, episodes_before, counters.episodes
        ):
            self._evaluate(stop)
        self._take_time()
        self.recorder.show(counters)
        # Last: a run that continues here would miss anything later in this step.
        overdue = time.monotonic() - self._last_commit >= cadence.commit_seconds
        if overdue or passed(cadence.commit_episodes, episodes_before, counters.episodes):
            self.commit()

    def _take_time(self) -> None:
        self.counters.seconds = time.monotonic() - self._session_start

    def _evaluate(self, stop: Callable[[], bool]) -> None:
        self.recorder.evaluate(self.counters, self.emulators.num_envs, self.has_ended, stop)

    def _end(self, stop: Callable[[], bool]) -> Outcome:
        if self.has_ended and self.recorder.cadence.evaluate_at_end:
            self._evaluate(stop)
        outcome: Outcome = "finished" if self.plan.done(self.counters) >= self.plan.length else "budget"
        if not self.has_ended or self.recorder.done.owes_evaluation:
            outcome = "interrupted"
        self._take_time()
        self.recorder.end(self.counters, outcome)
        self.commit()
        return outcome
