"""What a person sees of a training: a bar on a terminal, plain lines elsewhere."""

import time
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table

from atlantis_exp.statistics import EARLY_FRAMES, RANDOM_SCORE

if TYPE_CHECKING:
    from atlantis_exp.training.evaluation import Episode, Evaluation
    from atlantis_exp.training.trainer import Trainer

_PLAIN_SECONDS = 10.0  # between two plain lines
_WINDOW_SECONDS = 30.0  # that the speed is measured over


class Progress:
    """Shows episode, score, mean of 20, epsilon, steps a second, phase and time left."""

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or Console(highlight=False, soft_wrap=True)
        self.steps_per_second = 0.0
        self._marks: deque[tuple[float, int]] = deque()  # time, steps
        self._shown = 0.0  # time
        self._live: Live | None = None

    def say(self, text: str) -> None:
        """A line of its own."""
        self.console.print(text, markup=False)

    def update(self, trainer: "Trainer") -> None:
        """To be called after every step: draws a few times a second, or writes a line now and then."""
        now = time.monotonic()
        if now - self._shown < (0.25 if self.console.is_terminal else _PLAIN_SECONDS):
            return
        first = self._shown == 0.0
        self._shown = now
        self._marks.append((now, trainer.counters.steps))
        while now - self._marks[0][0] > _WINDOW_SECONDS and len(self._marks) > 2:
            self._marks.popleft()
        then, steps = self._marks[0]
        elapsed = now - then
        self.steps_per_second = (trainer.counters.steps - steps) / elapsed if elapsed > 0 else 0.0
        if self.console.is_terminal:
            self._draw(trainer)
        elif not first:
            self.say(self._line(trainer))

    def evaluating(self, episodes: Sequence["Episode"], over: int) -> None:
        """To be called after every step of an evaluation: writes a line now and then. Good games last for minutes."""
        now = time.monotonic()
        if self._shown == 0.0:
            self._shown = now
        if now - self._shown >= _PLAIN_SECONDS:
            self._shown = now
            steps, high = sum(episode.steps for episode in episodes), max(episode.score for episode in episodes)
            self.say(
                f"  evaluation: {over} of {len(episodes)} episodes over, {steps:,} steps, highest score {high:,.0f}"
            )

    def evaluated(self, trainer: "Trainer", evaluation: "Evaluation") -> None:
        """To be called after every evaluation."""
        self._marks.clear()  # the time it took is not the training's
        summary = evaluation.summary
        self.say(
            f"step {trainer.counters.steps:,}, {summary.episodes} episodes evaluated at epsilon {evaluation.epsilon}: "
            f"mean {summary.mean:,.0f} +- {summary.standard_error:,.0f}, high {summary.high:,.0f}, "
            f"low {summary.low:,.0f}, interquartile mean {summary.interquartile_mean:,.0f}"
        )
        if evaluation.collapsed:
            self.say(f"warning: the policy has {evaluation.policy}; any one action, held, scores 2,000")
        if summary.mean < RANDOM_SCORE and trainer.counters.frames <= EARLY_FRAMES:
            self.say(
                f"  below the published random player's {RANDOM_SCORE:,.0f}, which is normal here: "
                f"at 5 M frames published DQN is at 7,000 to 9,000 (docs/comparison.md)"
            )

    def close(self) -> None:
        """End the bar."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    def _line(self, trainer: "Trainer") -> str:
        counters = trainer.counters
        scores = trainer.recent_scores(20)
        shown = "first episode"
        if scores:
            lengths = [played.length for played in trainer.episodes[-100:]]
            shown = (
                f"score {scores[-1]:,.0f}  mean of 20 {np.mean(scores):,.0f}  "
                f"duration {lengths[-1]:,} (mean of 100 {np.mean(lengths):,.0f})"
            )
        done, length = trainer.done, trainer.plan.length
        left = self._time_left(trainer)
        return (
            f"episode {counters.episodes + 1:,}  {shown}  epsilon {trainer.epsilon:.2f}  "
            f"step {counters.steps:,}  updates {trainer.learner.updates:,}  {self.steps_per_second:,.0f} steps/s  "
            f"phase {trainer.phase.name}  {done / length:.1%}  left {left}"
        )

    def _time_left(self, trainer: "Trainer") -> str:
        share = trainer.done / trainer.plan.length
        if share <= 0 or self.steps_per_second <= 0:
            return "?"
        steps = trainer.counters.steps * (1 - share) / share
        if trainer.max_steps is not None:
            steps = min(steps, trainer.max_steps - trainer.counters.steps)
        minutes, seconds = divmod(int(max(steps, 0) / self.steps_per_second), 60)
        return f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}"

    def _draw(self, trainer: "Trainer") -> None:
        table = Table.grid(padding=(0, 1))
        table.add_row(ProgressBar(total=trainer.plan.length, completed=trainer.done, width=24), self._line(trainer))
        if self._live is None:
            self._live = Live(table, console=self.console, transient=True, auto_refresh=False)
            self._live.start()
        self._live.update(table, refresh=True)
