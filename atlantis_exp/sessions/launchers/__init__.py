"""What runs the jobs of a sweep: this process, or workers of joblib, Ray or Slurm, a file each.

In: the sweep's jobs. Out: contexts in which Hydra's launcher runs them, and what a worker does with one of them.
"""

import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any, NamedTuple, NoReturn

from atlantis_exp import terminal
from atlantis_exp.faults import Fault
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.journal import Journal

APART = "apart"
"""The launcher of a job that a worker of joblib's has left to a process of its own."""
JOB_OF = "ATLANTIS_EXP_JOB_OF"
"""The environment variable that tells a process that it does one job of a sweep, apart from its launcher's worker."""

_STOP_SECONDS = 300.0  # that jobs have to commit once their sweep ends


class Launcher(NamedTuple):
    """What runs the jobs of a sweep: an option of `hydra/launcher`, or Hydra's own, which runs them here in turn."""

    name: str = "basic"
    n_jobs: int | None = None  # at a time, as joblib counts them
    ray: dict[str, Any] | None = None  # what `ray.init` takes

    @property
    def is_basic(self) -> bool:
        """Whether the jobs are done in the sweep's own process."""
        return self.name == "basic"


BASIC = Launcher()


@contextmanager
def as_one_line(name: str) -> Iterator[None]:
    """Turn what no one foresaw into the one line that a launcher can carry from machine to machine."""
    try:
        yield
    except (Fault, OSError):
        raise
    except Exception as error:
        traceback.print_exc()
        raise Fault(f"run {name}: {type(error).__name__}: {error}") from error


@contextmanager
def committed_at_the_end(
    journal: Journal, folders: Sequence[RunFolder], close_page: Callable[[], None], is_masked: bool
) -> Iterator[None]:
    """Have all jobs commit before the sweep ends, be it by SIGINT or SIGTERM, whose exit code is then a run's.

    is_masked: whether the workers are to be spared these signals.
    """
    own = [folder for folder in folders if not folder.is_held]
    exit_code: int | None = None

    def stop() -> None:
        close_page()  # it writes the journal, too
        patience = time.monotonic() + _STOP_SECONDS
        if any(folder.is_held for folder in own):
            journal.status("KILLED")  # the jobs look at it
            while any(folder.is_held for folder in own) and time.monotonic() < patience:
                time.sleep(0.2)

    def end(number: int, _: FrameType | None) -> NoReturn:
        nonlocal exit_code
        exit_code = 128 + number
        signal.signal(number, signal.SIG_DFL)  # a second one ends the process at once
        terminal.warn(f"{signal.Signals(number).name}: the jobs commit and end")
        stop()
        sys.exit(exit_code)

    handlers = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, handlers if is_masked else ())
    try:
        yield
    except SystemExit as exiting:
        if exit_code is not None:
            exiting.code = exit_code  # which Ray replaces by 1
        raise
    finally:
        stop()
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in handlers.items():
            signal.signal(number, handler)


def job_apart() -> str | None:
    """The launcher of this process's job where a worker has left it to this process."""
    return os.environ.get(JOB_OF)
