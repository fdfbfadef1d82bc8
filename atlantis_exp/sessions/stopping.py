"""Ask a training to stop: on a signal, when its time is up, or when its sweep has ended."""

import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import inf
from types import FrameType
from typing import Any, NoReturn

from atlantis_exp import interrupts, terminal
from atlantis_exp.faults import Fault
from atlantis_exp.runs.folder import RunFolder

_LOOK_SECONDS = 1.0  # between two checks that the sweep goes on


class StopRequest:
    """A flag that the trainer polls, set by SIGINT, SIGTERM, SIGUSR2, the end of the time or of the sweep.

    Time counts from the first poll, after the first step, so that a session with a long set-up makes progress. A SIGINT
    after another signal ends the process at once; the last commit stays. Under Slurm SIGTERM is a warning: the run
    commits and goes on, since Slurm itself requeues or kills it.
    """

    def __init__(
        self,
        seconds: float | None = None,
        sweep_goes_on: Callable[[], bool] = lambda: True,
        under_slurm: bool = False,
    ) -> None:
        self.signal: int | None = None
        self._under_slurm = under_slurm
        self._is_warned = False  # by Slurm
        self._seconds = seconds
        self._deadline = inf
        self._sweep_goes_on = sweep_goes_on
        self._sweep_has_ended = False
        self._looked = 0.0  # time
        self._before: dict[int, Any] = {}  # handlers

    def __call__(self) -> bool:
        now = time.monotonic()
        if self._seconds is not None and self._deadline == inf:
            self._deadline = now + self._seconds
        if now - self._looked >= _LOOK_SECONDS:
            self._looked = now
            self._sweep_has_ended = self._sweep_has_ended or not self._sweep_goes_on()
        return self.signal is not None or self._is_warned or self._sweep_has_ended or now >= self._deadline

    def was_a_warning(self) -> bool:
        """Return whether the run goes on after its commit; forget the warning."""
        was_warned, self._is_warned = self._is_warned, False
        return was_warned and self.signal is None

    def end(self, message: str) -> NoReturn:
        """Exit with the signal's code. Raises: Fault if none came, so that a sweep goes on."""
        if self.signal is None and self._sweep_has_ended:
            raise Fault(f"the sweep has ended: {message}", exit_code=128 + signal.SIGTERM)
        if self.signal is None:
            raise Fault(f"budget.wall_clock: {message}", exit_code=124)  # as timeout(1) does
        terminal.warn(f"{signal.Signals(self.signal).name}: {message}")
        if self.signal == signal.SIGUSR2 and callable(handler := self._before[signal.SIGUSR2]):
            handler(self.signal, None)  # submitit's handler requeues the job and exits
        sys.exit(128 + self.signal)

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Handle the signals while the block runs."""
        with interrupts.handled(self._receive, signal.SIGINT, signal.SIGTERM, signal.SIGUSR2) as self._before:
            if interrupts.seen():  # and was swallowed
                self.signal = signal.SIGINT
            yield

    def _receive(self, number: int, _: FrameType | None) -> None:
        if self.signal is not None and number == signal.SIGINT:
            signal.signal(signal.SIGINT, signal.SIG_DFL)
            signal.raise_signal(signal.SIGINT)
        if number == signal.SIGTERM and self._under_slurm:
            self._is_warned = True  # a SIGUSR2 before it still requeues the job
        else:
            self.signal = number


def sweep_goes_on(folder: RunFolder, launcher: str | None) -> Callable[[], bool]:
    """Return a test of whether this job's launcher is alive; always true for Slurm, whose jobs may outlive it."""
    if folder.parent is None or launcher != "joblib":
        return lambda: True
    sweep = RunFolder(folder.parent)
    return lambda: sweep.is_held
