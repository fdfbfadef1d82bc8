"""Record a training: its episodes, curves, pictures, evaluations and description.

`Recorder.curves` is the place to add a metric of the training, `Evaluation.metrics` one of an evaluation.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field

from atlantis_exp import terminal
from atlantis_exp.faults import Fault
from atlantis_exp.learning.learner import Learner
from atlantis_exp.media import score_heatmap, score_histogram
from atlantis_exp.replay.memory import ReplayMemory
from atlantis_exp.runs.files import checked
from atlantis_exp.runs.folder import BEST_EPISODE, EPISODES, EVALUATED, NETWORK, TABLE_COLUMNS, evaluation_at
from atlantis_exp.runs.journal import Journal
from atlantis_exp.training.checkpoint import to_safetensors
from atlantis_exp.training.evaluation import Evaluation, Stopped
from atlantis_exp.training.plan import Cadence, Counters, Plan
from atlantis_exp.training.progress import Pace, Progress

Stop = Callable[[], bool]
Play = Callable[[int, Progress, Stop], Evaluation]
"""Plays a number of episodes. Raises: Stopped."""
Film = Callable[[Evaluation, Progress, Stop], bytes | None]
"""Returns an mp4 of an evaluation's best episode, or None without a film. Raises: Stopped."""


class Played(NamedTuple):
    """A training episode, with the training's counters at its end."""

    episode: int  # counted from 1
    step: int
    frames: int
    score: float
    length: int  # steps
    env: int


@dataclass
class Evaluations:
    """The evaluations of a training so far, as its checkpoints keep them."""

    best_mean: float | None
    evaluations: Annotated[int, Field(ge=0, lt=2**53)]
    evaluated_at: Annotated[int, Field(ge=-1, lt=2**53)]  # step, as it was written down
    owes_evaluation: bool  # of this step: it was stopped; resume repeats it
    best_step: Annotated[int, Field(ge=-1, lt=2**53)]
    last_report: str
    last_metrics: dict[str, int | float]  # ints stay ints: resume is bit for bit
    best_sha256: str = ""  # of the weights evaluated there, as a file; missing in 0.1.0


class Diverged(Fault):
    """The loss was not finite; the last commit is older."""


@dataclass(kw_only=True, eq=False)
class Recorder:
    """Report a training to a journal and a person, without influence on it."""

    plan: Plan
    cadence: Cadence
    learner: Learner
    memory: ReplayMemory
    journal: Journal
    progress: Progress
    play: Play
    film: Film
    score_range: tuple[float, float]  # the axis of the pictures of scores
    about: str = ""  # markdown at the end of the run's description

    def __post_init__(self) -> None:
        self.episodes: list[Played] = []
        self.done = Evaluations(None, 0, -1, False, -1, "", {})
        self._pace = Pace()
        self._last_step: int | None = None

    def begin(self, counters: Counters, last_step: int | None) -> None:
        """Begin a session, before its first step."""
        self._pace = Pace()
        self._pace.tick(counters.steps)
        self._last_step = last_step
        self._describe("running", counters)

    def end(self, counters: Counters, outcome: str) -> None:
        """End a session, before its last commit."""
        self._write_episodes()
        self._describe(outcome, counters)

    def episode(self, played: Played) -> None:
        """Record an episode, and draw the pictures of a full window."""
        self.episodes.append(played)
        self.journal.metrics({"score/episode": played.score, "score/length": played.length}, played.step)
        if played.episode % self.cadence.histogram_episodes == 0:
            window = self.recent_scores(self.cadence.histogram_episodes)
            title = f"training, episodes {played.episode - len(window) + 1}-{played.episode}"
            # The slider counts windows, not steps: at each position every run has a picture.
            number = played.episode // self.cadence.histogram_episodes - 1
            self.journal.image("score/histogram", score_histogram(window, title, self.score_range), number)
            ends = [each.episode if self.plan.unit == "episodes" else each.step for each in self.episodes]
            scores, plan = self.recent_scores(played.episode), self.plan
            picture = score_heatmap(ends, scores, plan.length, plan.unit, self.score_range)
            self.journal.image("score/heatmap", picture, number)

    def curves(self, counters: Counters) -> None:
        """Record a point of every curve. Raises: Diverged."""
        # At the last multiple, so that curves of runs with different num_envs share their grid.
        step = counters.steps - counters.steps % self.cadence.curve_steps
        self._pace.tick(counters.steps)  # else the first step of a session would have none
        measures = {f"learning/{name}": value for name, value in self.learner.statistics().items()}
        self.refuse_divergence()
        if self.episodes:
            last = self.recent_scores(100)
            measures |= {
                "score/mean_20": float(np.mean(last[-20:])),
                "score/mean_100": float(np.mean(last)),
                "score/best_100": max(last),
                "score/length_mean_100": float(np.mean([played.length for played in self.episodes[-100:]])),
            }
        self.journal.metrics(
            {
                **measures,
                "actions/exploration_share": counters.random / counters.steps,
                "actions/epsilon": self.plan.epsilon_at(counters),
                "learning/learning_rate": self.learner.learning_rate,
                "learning/updates": self.learner.updates,
                "learning/phase": self.plan.phases.index(self.plan.phase_at(counters)),
                "throughput/episodes": counters.episodes,
                "throughput/frames": counters.frames,
                "throughput/memory": len(self.memory),
                "throughput/memory_bytes": self.memory.nbytes,
                "throughput/steps_per_second": self._pace.steps_per_second,
                "throughput/hours": counters.seconds / 3600,
            },
            step,
        )

    def refuse_divergence(self) -> None:
        """Raise Diverged if any loss so far was not finite; wait for the device."""
        if (update := self.learner.first_nonfinite_update()) is not None:
            raise Diverged(
                f"the loss of update {update} is not finite, and would be again; the run stays at its last commit: "
                "lower optimizer.lr or set objective.reward_clip, which starts a new run"
            )

    def show(self, counters: Counters) -> None:
        """Show the progress if due; call it after every step."""
        self._pace.tick(counters.steps)
        if self.progress.is_due():
            done, length = self.plan.done(counters), self.plan.length
            left = counters.steps * (length - done) / done if done else None
            if left is not None and self._last_step is not None:
                left = min(left, self._last_step - counters.steps)
            now = self.plan.epsilon_at(counters), self.learner.updates, self._pace.steps_per_second
            phase = self.plan.phase_at(counters).name
            self.progress.show(*line_of(counters, self.episodes[-100:], *now, phase, left))

    def evaluate(self, counters: Counters, num_envs: int, has_ended: bool, stop: Stop) -> None:
        """Evaluate this step's network and keep its weights; pending if stopped. Raises: Diverged."""
        step, done = counters.steps, self.done
        if (every := self.cadence.evaluate_steps) and not has_ended:
            # It belongs to the step at which it was due, as with the curves; the last one to the run's last step, where
            # comparisons look for it.
            due = step - step % every
            step = due if step - due < num_envs else step
        episodes = self.cadence.final_episodes if has_ended else self.cadence.interim_episodes
        # A run that continues from an evaluation may end there, and then owes a longer one.
        if step == done.evaluated_at and done.last_metrics["evaluation/episodes"] >= episodes:
            return
        self.refuse_divergence()
        done.owes_evaluation = True
        try:
            with self._pace.paused():
                evaluation = self.play(episodes, self.progress, stop)
                is_best = done.best_mean is None or evaluation.summary.mean > done.best_mean
                video = self.film(evaluation, self.progress, stop) if is_best else None
        except Stopped:
            return
        done.owes_evaluation = False
        metrics = evaluation.metrics()
        self.journal.metrics(metrics, step)
        self.journal.tags({"policy": evaluation.policy})
        scores = [episode.score for episode in evaluation.episodes]
        title = f"evaluation, step {step:,}"
        self.journal.image("evaluation/histogram", score_histogram(scores, title, self.score_range), done.evaluations)
        done.evaluations += 1
        table = evaluation_at(step)
        self.journal.artifact(table, evaluation.table().to_csv().encode())
        self.journal.artifact(table.replace(".csv", ".txt"), evaluation.report().encode())
        weights = to_safetensors(self.learner.evaluated.state_dict())
        results = {name: value for name, value in metrics.items() if name.startswith("evaluation/")}
        self.journal.model(NETWORK, weights, step, results, best=is_best)
        if is_best:
            done.best_mean, done.best_step = evaluation.summary.mean, step
            done.best_sha256 = hashlib.sha256(weights).hexdigest()
            self.journal.tags({"best_evaluation": f"mean {evaluation.summary.mean:,.0f} at step {step}"})
            if video is not None:
                self.journal.artifact(BEST_EPISODE, video)
        done.evaluated_at, done.last_report, done.last_metrics = step, evaluation.report(), metrics
        self._write_episodes()
        self._describe("running", counters)
        self.progress.evaluated(step, counters.frames, evaluation)

    def recent_scores(self, count: int) -> list[float]:
        return [played.score for played in self.episodes[-count:]]

    def state_dict(self) -> dict[str, Any]:
        return {
            "episodes": np.array(self.episodes).reshape(-1, len(Played._fields)),
            **asdict(self.done),
            "tracker": self.journal.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        for episode, step, frames, score, length, env in state["episodes"].tolist():
            self.episodes.append(Played(int(episode), int(step), int(frames), score, int(length), int(env)))
        if not np.isfinite(self.recent_scores(len(self.episodes))).all():
            raise ValueError("the scores are not finite")
        self.done = checked(Evaluations, state)
        if self.done.last_metrics and (missing := EVALUATED - self.done.last_metrics.keys()):
            raise ValueError(f"the last evaluation lacks {min(missing)}")
        if self.done.last_metrics and self.done.best_mean is None:
            raise ValueError("the best mean of its evaluations is missing")
        self.journal.load_state_dict(state["tracker"])

    def _write_episodes(self) -> None:
        lines = [",".join(f"{value:g}" if value % 1 else f"{value:.0f}" for value in row) for row in self.episodes]
        self.journal.artifact(EPISODES, "\n".join([",".join(Played._fields), *lines, ""]).encode())

    def _describe(self, state: str, counters: Counters) -> None:
        """Describe the run's state, progress and result in markdown."""
        done, reached = self.done, self.done.last_metrics
        lines = [  # the result first: MLflow shows five lines and folds the rest
            f"**{state}** at step {counters.steps:,}: {counters.episodes:,} episodes, {counters.frames:,} frames, "
            f"{self.learner.updates:,} updates, {counters.seconds / 3600:.2f} hours",
        ]
        if state == "finished" and counters.episodes < 2:
            lines.append("Too short for a curve of scores, which needs two ended episodes.")
        if reached:
            scores = " | ".join(f"{reached[f'evaluation/{point}']:,.0f}" for point in TABLE_COLUMNS)
            lines += [
                f"The best mean so far is {done.best_mean:,.0f}, at step {done.best_step:,}.",
                "| evaluated at step | mean | +- | median | IQM | high | low | epsilon | episodes | random |\n"
                f"|{' ---: |' * 10}\n| {done.evaluated_at:,} | {scores} | {reached['evaluation/epsilon']} | "
                f"{reached['evaluation/episodes']:.0f} | {reached['actions/random_share']:.1%} |",
            ]
        self.journal.note("\n\n".join([*lines, self.about]))


def line_of(
    counters: Counters,
    played: Sequence[Played],
    epsilon: float,
    updates: int,
    pace: float,
    phase: str,
    left: float | None,
) -> tuple[str, float]:
    """Return a training's progress in words, and its completed share.

    Args:
        played: the last 100 episodes.
        pace: steps a second.
        left: steps until the plan or the budget ends; None if unknown.
    """
    share = 0.0 if left is None else counters.steps / (counters.steps + max(left, 0.0))
    shown, time_left = "first episode", "?"
    if played:
        shown = (
            f"score {played[-1].score:,.0f}  mean of 20 {np.mean([each.score for each in played[-20:]]):,.0f}  "
            f"duration {played[-1].length:,} (mean of 100 {np.mean([each.length for each in played]):,.0f})"
        )
    if left is not None and pace > 0 and updates:
        time_left = terminal.clock(left / pace)  # steps are faster without updates
    line = (
        f"episode {counters.episodes + 1:,}  {shown}  epsilon {epsilon:.2f}  step {counters.steps:,}  "
        f"updates {updates:,}  {pace:,.0f} steps/s  phase {phase}  {share:.1%}  left {time_left}"
    )
    return line, share
