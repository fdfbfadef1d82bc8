"""Show a training to a person: a bar on a terminal, plain lines elsewhere."""

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from math import isnan
from typing import TYPE_CHECKING

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table

from atlantis_exp import terminal

if TYPE_CHECKING:
    from atlantis_exp.training.evaluation import Episode, Evaluation

_DRAW_SECONDS = 0.25  # between two states of the bar
_WINDOW_SECONDS = 30.0  # of the measured pace
_MARK_SECONDS = 0.25  # between two marks in that window


class Pace:
    """Measure steps a second over the last half minute, without pauses."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._marks: deque[tuple[float, int]] = deque()  # time, steps
        self._latest = (0.0, 0)

    def tick(self, steps: int) -> None:
        """Note the time of a step; call it after every step, and once before the first."""
        self._latest = now, _ = self._clock(), steps
        if not self._marks or now - self._marks[-1][0] >= _MARK_SECONDS:
            self._marks.append(self._latest)
        while now - self._marks[0][0] > _WINDOW_SECONDS and len(self._marks) > 2:
            self._marks.popleft()

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Exclude the time of the block."""
        start = self._clock()
        try:
            yield
        finally:
            pause = self._clock() - start
            self._marks = deque((then + pause, steps) for then, steps in self._marks)
            self._latest = (self._latest[0] + pause, self._latest[1])

    @property
    def steps_per_second(self) -> float:
        """The pace at the latest tick; 0 before the second one."""
        if not self._marks or (seconds := self._latest[0] - self._marks[0][0]) <= 0:
            return 0.0
        return (self._latest[1] - self._marks[0][1]) / seconds


class Progress:
    """Show episode, score, mean of 20, epsilon, steps a second, phase and time left."""

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or terminal.console()
        self._shown: float | None = None  # time
        self._lines = 0  # since the first one fell due
        self._evaluated: Sequence[Episode] | None = None  # under way
        self._began = 0.0  # time, of that
        self._live: Live | None = None

    def say(self, text: str) -> None:
        self.console.print(text)

    def is_due(self) -> bool:
        """Return whether `show` is due: a few times a second on a terminal, now and then elsewhere."""
        if self.console.is_terminal:
            return self._shown is None or time.monotonic() - self._shown >= _DRAW_SECONDS
        return self._is_time_for_a_line()

    def show(self, line: str, share: float) -> None:
        """Draw a training's bar with its line and completed share, or write the line."""
        if not self.console.is_terminal:
            self._write(line)
            return
        self._shown = time.monotonic()
        table = Table.grid(padding=(0, 1))
        table.add_row(ProgressBar(total=1.0, completed=share, width=24), line)
        if self._live is None:
            self._live = Live(table, console=self.console, transient=True, auto_refresh=False)
            self._live.start()
        self._live.update(table, refresh=True)

    def evaluating(self, episodes: Sequence["Episode"], most_frames: int) -> None:
        """Write a line now and then; call it after every step of an evaluation.

        The cap of `most_frames` an episode bounds the time left.
        """
        if self._evaluated is not episodes:
            self._evaluated, self._began = episodes, time.monotonic()
        if self._is_time_for_a_line():
            steps, high = sum(episode.steps for episode in episodes), max(episode.score for episode in episodes)
            frames = sum(most_frames if episode.over else episode.frames for episode in episodes)
            left = (most_frames * len(episodes) / frames - 1) * (time.monotonic() - self._began)
            over = sum(episode.over for episode in episodes)
            self._write(
                f"  evaluation: {over} of {len(episodes)} episodes over, {steps:,} steps, highest score {high:,.0f}, "
                f"at most {terminal.clock(left)} left"
            )

    def filming(self, drawn: int, pictures: int) -> None:
        """Write a line now and then; call it with every picture of a film."""
        if self._is_time_for_a_line():
            self._write(f"  film: {drawn:,} of {pictures:,} steps")

    def evaluated(self, step: int, frames: int, evaluation: "Evaluation") -> None:
        """Print a training's evaluation at a step, after a number of training frames."""
        summary, game = evaluation.summary, evaluation.game
        self.say(
            f"step {step:,}, {summary.episodes} episodes evaluated at epsilon {evaluation.epsilon}: "
            f"mean {summary.mean:,.0f} +- {summary.standard_error:,.0f}, high {summary.high:,.0f}, "
            f"low {summary.low:,.0f}, interquartile mean {summary.interquartile_mean:,.0f}"
        )
        if evaluation.collapsed:
            held = "" if isnan(game.held_score) else f"; holding any one action scores {game.held_score:,.0f}"
            self.say(f"warning: the policy has {evaluation.policy}{held}")
        if summary.mean < game.random_score and frames <= game.early_frames:
            self.say(
                f"  below the published random player's {game.random_score:,.0f}, which is normal here: "
                f"{game.early_scores}"
            )

    def _is_time_for_a_line(self) -> bool:
        if self._shown is None:  # the first line waits for some progress
            self._shown = time.monotonic()
        return time.monotonic() - self._shown >= terminal.until_line(self._lines)

    def _write(self, line: str) -> None:
        self._shown = time.monotonic()
        self._lines += 1
        self.say(line)

    def close(self) -> None:
        """End the bar."""
        if self._live is not None:
            self._live.stop()
            self._live = None
