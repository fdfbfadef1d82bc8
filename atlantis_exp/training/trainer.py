"""The training loop (report figure 3.1), as a page that reads like it."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import safetensors.torch
import torch

from atlantis_exp.game.preprocessing import FrameStack
from atlantis_exp.game.vector import Emulators, Steps
from atlantis_exp.learning.learner import Learner
from atlantis_exp.learning.schedules import Schedule
from atlantis_exp.media import score_heatmap, score_histogram
from atlantis_exp.replay.memory import ReplayMemory, Returns
from atlantis_exp.replay.samplers import Sampler
from atlantis_exp.statistics import TABLE_COLUMNS
from atlantis_exp.tracking.journal import Tracker
from atlantis_exp.training.actor import Actor, Decisions
from atlantis_exp.training.checkpoint import Checkpoints
from atlantis_exp.training.evaluation import Evaluation, Stopped
from atlantis_exp.training.progress import Progress

Unit = Literal["episodes", "steps"]
Outcome = Literal["finished", "budget", "interrupted"]
Stop = Callable[[], bool]
Evaluate = Callable[[int, Progress, Stop], tuple[Evaluation, bytes | None]]
"""Plays so many episodes; with a film of the best one, if there is to be one. Raises: Stopped."""


class Played(NamedTuple):
    """An episode of the training, and where the training stood at its end."""

    episode: int  # counted from 1
    step: int
    frames: int
    score: float
    length: int  # steps
    env: int


class Diverged(RuntimeError):
    """The loss was no finite number; the last commit is from before."""


@dataclass(frozen=True)
class Phase:
    """A stretch of training with its own learning rate and sampler."""

    name: str
    length: int  # in the plan's unit
    learning_rate: float
    sampler: Sampler


@dataclass(frozen=True)
class Plan:
    """What is trained when: phases one after the other, all measured in episodes or all in steps."""

    unit: Unit
    phases: Sequence[Phase]
    epsilon: Schedule
    learning_rate: Schedule  # share of the phase's
    returns: Returns
    terminal_on_life_loss: bool  # for what is learned; the episode goes on
    learn_every: int  # steps
    learn_start: int  # transitions in the memory
    batch_size: int  # transitions

    @property
    def length(self) -> int:
        """Of all phases together, in the plan's unit."""
        return sum(phase.length for phase in self.phases)

    def phase_at(self, done: int) -> Phase:
        """The phase after `done` units; the last one keeps what comes after it."""
        for phase in self.phases:
            done -= phase.length
            if done < 0:
                return phase
        return self.phases[-1]


@dataclass(frozen=True)
class Cadence:
    """How often things are written down, all of it without influence on what is learned."""

    curve_steps: int  # steps between two points of a curve
    histogram_episodes: int  # episodes in a window's histogram
    commit_episodes: int  # episodes between two commits
    commit_seconds: float  # seconds between two commits at the most
    evaluate_episodes: int | None  # training episodes between two evaluations
    evaluate_steps: int | None  # training steps between two evaluations
    evaluate_at_end: bool
    interim_episodes: int  # of an evaluation amid the training
    final_episodes: int  # of the one at its end


@dataclass
class Counters:
    """What was done so far, over all sessions."""

    steps: int = 0
    frames: int = 0
    episodes: int = 0
    random: int = 0  # decisions that chance took
    learn_ticks: int = 0  # multiples of learn_every that have passed
    seconds: float = 0.0


class Trainer:
    """One run: built parts in, `run` until the plan, the budget or a stop request ends it.

    With one environment the loop is the report's, one thing after the other. With several, the updates that are due
    run while the emulators play; what is done, and in which order it takes effect, never depends on timing.
    """

    def __init__(
        self,
        *,
        plan: Plan,
        cadence: Cadence,
        emulators: Emulators,
        stack: FrameStack,
        actor: Actor,
        memory: ReplayMemory,
        learner: Learner,
        exploration: Sequence[np.random.Generator],
        sampling: np.random.Generator,
        seeds: Sequence[int],
        tracker: Tracker,
        checkpoints: Checkpoints,
        evaluate: Evaluate,
        progress: Progress,
        max_steps: int | None,
        about: str = "",
    ) -> None:
        self.plan, self.cadence = plan, cadence
        self.emulators, self.stack, self.actor = emulators, stack, actor
        self.memory, self.learner = memory, learner
        self.exploration, self.sampling, self.seeds = exploration, sampling, seeds
        self.tracker, self.checkpoints, self.evaluate, self.progress = tracker, checkpoints, evaluate, progress
        self.max_steps = max_steps
        self.about = about  # markdown: what the run is and how to continue it
        self.counters = Counters()
        self.scores = np.zeros(emulators.num_envs)  # of the episodes under way
        self.lengths = np.zeros(emulators.num_envs, np.int64)  # of the episodes under way, steps
        self.episodes: list[Played] = []
        self.best_mean = -np.inf  # of all evaluations
        self.evaluations = 0
        self.evaluated_at = -1  # steps
        self.owes_evaluation = False  # of this very step: it was asked to stop
        self.best_step = -1
        self.last_report = ""  # of the latest evaluation
        self.last_metrics: dict[str, float] = {}  # of the latest evaluation
        self._errors: list[
            tuple[Sampler, npt.NDArray[np.int64], torch.Tensor]
        ] = []  # of updates since the last feedback

    def run(self, stop: Stop = lambda: False) -> Outcome:
        """Train from where the counters stand; commits before it returns.

        Raises:
            Diverged: when the loss is no finite number; nothing is committed then.
            WorkerDied: when an emulator's process has ended.
            OSError: when a commit cannot be written; the last one stays.
        """
        if self.memory.next_id == 0:
            self._begin_all()
        self._session_start = time.monotonic() - self.counters.seconds
        self._last_commit = time.monotonic()
        self._stop = stop
        self._describe("running")
        if self.owes_evaluation:
            self._evaluate()
        while not self._ended and not stop():
            self._iterate()
        if self._ended and self.cadence.evaluate_at_end:
            self._evaluate()
        outcome: Outcome = "finished" if self.done >= self.plan.length else "budget"
        if not self._ended or self.owes_evaluation:
            outcome = "interrupted"
        self._record_episodes()
        self._describe(outcome)
        self.commit()
        return outcome

    @property
    def phase(self) -> Phase:
        """The phase under way."""
        return self.plan.phase_at(self.done)

    @property
    def epsilon(self) -> float:
        """The probability that chance takes the next decision."""
        # The report counts the episode under way as one: its first has epsilon(1), not epsilon(0).
        running = 1 if self.plan.unit == "episodes" else 0
        return self.plan.epsilon((self.done + running) / self.plan.length, self.counters.steps)

    def commit(self) -> None:
        """Make the checkpoint and all metrics up to it durable together, then visible."""
        self.counters.seconds = time.monotonic() - self._session_start
        if (update := self.learner.first_nonfinite_update()) is not None:
            raise Diverged(f"the loss of update {update} is no finite number; the run stays at its last commit")
        self.checkpoints.save(self.state_dict(), self.memory)
        self.tracker.commit()
        self._last_commit = time.monotonic()

    def state_dict(self) -> dict[str, Any]:
        self._feed_back()  # the same as at the next update: nothing is drawn before
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
            "episodes": np.array(self.episodes).reshape(-1, len(Played._fields)),
            "best_mean": None if np.isinf(self.best_mean) else self.best_mean,
            "evaluations": self.evaluations,
            "evaluated_at": self.evaluated_at,
            "owes_evaluation": self.owes_evaluation,
            "best_step": self.best_step,
            "last_report": self.last_report,
            "last_metrics": self.last_metrics,
            "tracker": self.tracker.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.counters = Counters(**{field.name: state["counters"][field.name] for field in fields(Counters)})
        self.learner.load_state_dict(state["learner"])
        self.emulators.load_state_dict(state["emulators"])
        self.stack.load_state_dict(state["stack"])
        for generator, generator_state in zip(self.exploration, state["exploration"], strict=True):
            generator.bit_generator.state = generator_state
        self.sampling.bit_generator.state = state["sampling"]
        for index, phase in enumerate(self.plan.phases):
            phase.sampler.load_state_dict(state["samplers"][str(index)])
        self.scores, self.lengths = state["scores"], state["lengths"]
        for episode, step, frames, score, length, env in state["episodes"].tolist():
            self.episodes.append(Played(int(episode), int(step), int(frames), score, int(length), int(env)))
        self.best_mean = -np.inf if state["best_mean"] is None else state["best_mean"]
        self.evaluations, self.evaluated_at = state["evaluations"], state["evaluated_at"]
        self.owes_evaluation = state["owes_evaluation"]
        self.best_step = state["best_step"]
        self.last_report, self.last_metrics = state["last_report"], state["last_metrics"]
        self.tracker.load_state_dict(state["tracker"])

    @property
    def done(self) -> int:
        return self.counters.episodes if self.plan.unit == "episodes" else self.counters.steps

    def recent_scores(self, count: int) -> list[float]:
        """The scores of the last `count` episodes, the latest last."""
        return [played.score for played in self.episodes[-count:]]

    @property
    def _ended(self) -> bool:
        budget_spent = self.max_steps is not None and self.counters.steps >= self.max_steps
        return budget_spent or self.done >= self.plan.length

    def _begin_all(self) -> None:
        envs = range(self.emulators.num_envs)
        observations = self.emulators.reset(envs, self.seeds)
        self.stack.reset(envs, observations)
        for env in envs:
            self.memory.begin(env, observations[env])

    def _iterate(self) -> None:
        """One step of every environment, and the updates that fall due."""
        overlap = self.emulators.num_envs > 1
        self.learner.learning_rate = self.phase.learning_rate * self.plan.learning_rate(
            self.done / self.plan.length, self.counters.steps
        )
        decisions = self.actor.act(self.stack.state, self.epsilon, self.exploration)
        self.emulators.send(decisions.actions)
        if overlap:
            self._learn()
        steps = self.emulators.receive()
        self._observe(decisions, steps)
        if not overlap:
            self._learn()
        self._write_down(steps)

    def _learn(self) -> None:
        due = self.counters.steps // self.plan.learn_every - self.counters.learn_ticks
        self.counters.learn_ticks += due
        if len(self.memory) <= self.plan.learn_start:
            return
        self._feed_back()
        for _ in range(due):
            sampler = self.phase.sampler
            ids, weights = sampler.sample(self.memory, self.plan.batch_size, self.sampling)
            errors = self.learner.update(*self.memory.gather(ids, self.plan.returns), weights)
            if weights is not None:
                self._errors.append((sampler, ids, errors))

    def _feed_back(self) -> None:
        """Tell the samplers the errors of the updates before; by now, the actor has waited for the device anyway."""
        for sampler, ids, errors in self._errors:
            sampler.feed_back(ids, errors.cpu().numpy())
        self._errors.clear()

    def _observe(self, decisions: Decisions, steps: Steps) -> None:
        self.stack.push(steps.observations)
        terminal = steps.terminated | (steps.life_lost & self.plan.terminal_on_life_loss)
        for env in range(self.emulators.num_envs):
            self.memory.add(
                env,
                int(decisions.actions[env]),
                float(steps.rewards[env]),
                steps.observations[env],
                bool(terminal[env]),
            )
        self.counters.steps += self.emulators.num_envs
        self.counters.frames += int(steps.frames.sum())
        self.counters.random += int(decisions.random.sum())
        self.scores += steps.rewards
        self.lengths += 1

    def _write_down(self, steps: Steps) -> None:
        cadence, now = self.cadence, self.counters
        steps_before, episodes_before = now.steps - self.emulators.num_envs, now.episodes
        for env in np.flatnonzero(steps.terminated | steps.truncated).tolist():
            self._end_episode(env)
        if _passed(cadence.curve_steps, steps_before, now.steps):
            self._record_curves()
        if _passed(cadence.evaluate_steps, steps_before, now.steps) or _passed(
            cadence.evaluate_episodes, episodes_before, now.episodes
        ):
            self._evaluate()
        now.seconds = time.monotonic() - self._session_start
        self.progress.update(self)
        # Last: what else falls due at this step would be missing from a run that continues here.
        overdue = time.monotonic() - self._last_commit >= cadence.commit_seconds
        if overdue or _passed(cadence.commit_episodes, episodes_before, now.episodes):
            self.commit()

    def _end_episode(self, env: int) -> None:
        score, length = float(self.scores[env]), int(self.lengths[env])
        self.scores[env], self.lengths[env] = 0.0, 0
        now = self.counters
        now.episodes += 1
        self.episodes.append(Played(now.episodes, now.steps, now.frames, score, length, env))
        self.tracker.metrics({"score/episode": score, "score/length": length}, now.steps)
        observation = self.emulators.reset([env])
        self.stack.reset([env], observation)
        self.memory.begin(env, observation[0])

        if now.episodes % self.cadence.histogram_episodes == 0:
            window = self.recent_scores(self.cadence.histogram_episodes)
            title = f"training, episodes {now.episodes - len(window) + 1}-{now.episodes}"
            # A slider that counts windows, not steps: at each of its positions every run has a picture.
            number = now.episodes // self.cadence.histogram_episodes - 1
            self.tracker.image("score/histogram", score_histogram(window, title), number)
            ends = [played.episode if self.plan.unit == "episodes" else played.step for played in self.episodes]
            picture = score_heatmap(ends, self.recent_scores(now.episodes), self.plan.length, self.plan.unit)
            self.tracker.image("score/heatmap", picture, number)

    def _record_curves(self) -> None:
        # The last multiple, not the step itself: curves of runs with different num_envs then share their grid.
        step = self.counters.steps - self.counters.steps % self.cadence.curve_steps
        measures = {f"learning/{name}": value for name, value in self.learner.statistics().items()}
        if (update := self.learner.first_nonfinite_update()) is not None:
            raise Diverged(f"the loss of update {update} is no finite number; the run stays at its last commit")
        if self.episodes:
            last = self.recent_scores(100)
            measures |= {
                "score/mean_20": float(np.mean(last[-20:])),
                "score/mean_100": float(np.mean(last)),
                "score/best_100": max(last),
                "score/length_mean_100": float(np.mean([played.length for played in self.episodes[-100:]])),
            }
        self.tracker.metrics(
            {
                **measures,
                "actions/exploration_share": self.counters.random / self.counters.steps,
                "actions/epsilon": self.epsilon,
                "learning/learning_rate": self.learner.learning_rate,
                "learning/updates": self.learner.updates,
                "learning/phase": self.plan.phases.index(self.phase),
                "throughput/episodes": self.counters.episodes,
                "throughput/frames": self.counters.frames,
                "throughput/memory": len(self.memory),
                "throughput/memory_bytes": self.memory.nbytes,
                "throughput/steps_per_second": self.progress.steps_per_second,
                "throughput/hours": self.counters.seconds / 3600,
            },
            step,
        )

    def _record_episodes(self) -> None:
        lines = [",".join(f"{value:g}" if value % 1 else f"{value:.0f}" for value in row) for row in self.episodes]
        self.tracker.artifact("episodes.csv", "\n".join([",".join(Played._fields), *lines, ""]).encode())

    def _describe(self, standing: str) -> None:
        """Say in a few lines of markdown what the run is, how it stands and what it has reached."""
        now, reached = self.counters, self.last_metrics
        lines = [
            self.about,
            f"**{standing}** at step {now.steps:,}: {now.episodes:,} episodes, {now.frames:,} frames, "
            f"{self.learner.updates:,} updates, {now.seconds / 3600:.2f} hours",
        ]
        if reached:
            scores = " | ".join(f"{reached[f'evaluation/{point}']:,.0f}" for point in TABLE_COLUMNS)
            lines += [
                "| evaluated at step | mean | +- | median | IQM | high | low | epsilon | episodes | random |\n"
                f"|{' ---: |' * 10}\n| {self.evaluated_at:,} | {scores} | {reached['evaluation/epsilon']} | "
                f"{reached['evaluation/episodes']:.0f} | {reached['actions/random_share']:.1%} |",
                f"The best mean so far is {self.best_mean:,.0f}, at step {self.best_step:,}.",
            ]
        self.tracker.note("\n\n".join(lines))

    def _evaluate(self) -> None:
        if self.counters.steps == self.evaluated_at:
            return
        step = self.counters.steps
        if every := self.cadence.evaluate_steps:
            # As with the curves: one that fell due on the way to this step belongs to where it fell due.
            due = step - step % every
            step = due if step - due < self.emulators.num_envs else step
        self.owes_evaluation = True
        try:
            episodes = self.cadence.final_episodes if self._ended else self.cadence.interim_episodes
            evaluation, video = self.evaluate(episodes, self.progress, self._stop)
        except Stopped:
            return
        self.owes_evaluation = False
        metrics = evaluation.metrics()
        self.tracker.metrics(metrics, step)
        self.tracker.tags({"policy": evaluation.policy})
        scores = [episode.score for episode in evaluation.episodes]
        title = f"evaluation, step {step:,}"
        self.tracker.image("evaluation/histogram", score_histogram(scores, title), self.evaluations)
        self.evaluations += 1
        self.tracker.artifact(f"evaluation/{step:09d}.csv", evaluation.table().encode())
        self.tracker.artifact(f"evaluation/{step:09d}.txt", evaluation.report().encode())
        weights = safetensors.torch.save(
            {name: tensor.contiguous() for name, tensor in self.learner.evaluated.state_dict().items()}
        )
        results = {name: value for name, value in metrics.items() if name.startswith("evaluation/")}
        is_best = evaluation.summary.mean > self.best_mean
        self.tracker.model("network", weights, step, results, best=is_best)
        if is_best:
            self.best_mean, self.best_step = evaluation.summary.mean, step
            self.tracker.artifact("best.safetensors", weights)
            self.tracker.tags({"best_evaluation": f"mean {evaluation.summary.mean:,.0f} at step {step}"})
            if video is not None:
                self.tracker.artifact("best_episode.mp4", video)
        self.evaluated_at, self.last_report = self.counters.steps, evaluation.report()
        self.last_metrics = metrics
        self._record_episodes()
        self._describe("running")
        self.progress.evaluated(self, evaluation)


def _passed(every: int | None, before: int, now: int) -> bool:
    return every is not None and now // every > before // every
