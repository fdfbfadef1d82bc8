"""Show a sweep's runs while other processes train them: a table on a terminal, else plain lines."""

import math
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field

from rich.console import Console
from rich.live import Live
from rich.table import Table

from atlantis_exp import terminal
from atlantis_exp.config import Config
from atlantis_exp.faults import Fault
from atlantis_exp.runs.folder import RunFolder, State
from atlantis_exp.runs.journal import Metrics, Tags, read, read_commit
from atlantis_exp.sessions.job import Job
from atlantis_exp.training.plan import step_of

_ORDER: tuple[State, ...] = ("running", "failed", "interrupted", "done", "queued")


@dataclass
class _Run:
    """A run as of its last commit; `look` reads only the new part of its journal."""

    title: str
    config: Config
    folder: RunFolder
    length: int  # of the plan, in its unit
    unit: str
    state: State = "queued"
    values: dict[str, float] = field(default_factory=dict)  # latest of each metric
    step: int = 0
    _identity: str = ""
    _offset: int = 0  # bytes read of the journal
    _updated: int = 0  # ms since 1970

    def look(self) -> None:
        self.state = self.folder.state
        commit = read_commit(self.folder.path)
        if commit is None or (commit.identity, commit.offset) == (self._identity, self._offset):
            return
        if commit.identity != self._identity:
            self._identity, self._offset = commit.identity, 0
        for _, record in read(self.folder.path, self._offset, commit.offset):
            if isinstance(record, Metrics):
                self.values |= record.values
                self.step = record.step
            elif isinstance(record, Tags) and "flops_per_update" in record.values:
                self._end_at(float(record.values["flops_per_update"]))
        self._offset, self._updated = commit.offset, commit.updated

    def _end_at(self, flops: float) -> None:
        """Shorten a plan in steps to what budget.flops allows, given the FLOPs of an update."""
        training, most = self.config.training, self.config.budget.flops
        if self.unit == "steps" and most is not None and flops > 0:
            last = step_of(math.ceil(most / flops), training.learn_start, training.learn_every)
            self.length = min(self.length, last)

    @property
    def done(self) -> int:
        return int(self.values.get("throughput/episodes", 0)) if self.unit == "episodes" else self.step

    @property
    def cells(self) -> tuple[str, ...]:
        """Title, state, progress, steps per second, time left, last score."""
        if not self.step:
            return self.title, self.state, "", "", "", ""
        speed, score = self.values.get("throughput/steps_per_second"), self.values.get("score/episode")
        return (
            self.title,
            self.state,
            f"{self.done:,} of {self.length:,} {self.unit}",
            f"{speed:,.0f}" if speed else "",
            self._left(),
            "" if score is None else f"{score:,.0f}",
        )

    def _left(self) -> str:
        """Return the time left at the speed shown; for a plan in episodes, at the mean of all so far."""
        hours, speed = self.values.get("throughput/hours"), self.values.get("throughput/steps_per_second")
        if self.state != "running" or not hours or not speed or not self.done:
            return ""
        seconds = 1 / speed if self.unit == "steps" else hours * 3600 / self.done
        since = time.time() - self._updated / 1000
        return terminal.clock((self.length - self.done) * seconds - since)


class LiveTable:
    """The shown runs of a sweep; call `look` every `seconds`."""

    def __init__(self, jobs: Sequence[Job], folders: Sequence[RunFolder], console: Console | None = None) -> None:
        self._console = console or terminal.console()
        self._runs = [_run(job, folder) for job, folder in zip(jobs, folders, strict=True)]
        self._said: dict[str, tuple[str, ...]] = {}
        self._live: Live | None = None
        self.seconds = 1.0 if self._console.is_terminal else 30.0

    def look(self) -> None:
        """Read the new parts of the journals, and show them."""
        for run in self._runs:
            with suppress(OSError, ValueError, Fault):  # a damaged journal, which the run's own command reports
                run.look()
        if self._console.is_terminal:
            self._draw()
        else:
            self._say()

    def close(self) -> None:
        if self._live is not None:
            self._live.stop()

    def _draw(self) -> None:
        table = Table("run", "state", "as of its last commit", "steps/s", "left", "last score", box=None)
        for run in sorted(self._runs, key=lambda run: _ORDER.index(run.state)):  # the last rows may not fit
            table.add_row(*run.cells)
        if self._live is None:
            self._live = Live(console=self._console, auto_refresh=False, transient=True)
            self._live.start()
        self._live.update(table, refresh=True)

    def _say(self) -> None:
        for run in self._runs:
            name, state, done, speed, left, score = run.cells
            news = state, done, speed, score  # but not the time left
            if self._said.get(name, ("queued", "", "", "")) != news:
                self._said[name] = news
                parts = [done, speed and f"{speed} steps/s", left and f"left {left}", score and f"last score {score}"]
                self._console.print(f"  {state:12}{name}  {'  '.join(filter(None, parts))}")


def _run(job: Job, folder: RunFolder) -> _Run:
    config = job.config
    lengths = [(phase.episodes, phase.steps) for phase in config.phase.values()]
    unit = "episodes" if lengths[0][0] else "steps"
    length = sum(episodes or steps or 0 for episodes, steps in lengths)
    if unit == "steps" and config.budget.steps is not None:
        length = min(length, config.budget.steps)
    return _Run(job.title, config, folder, length, unit)
