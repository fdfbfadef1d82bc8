"""Jobs side by side on this machine, each in a process of its own: whatever ends it, the others go on."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from types import FrameType
from typing import NoReturn

from atlantis_exp import terminal
from atlantis_exp.faults import Fault
from atlantis_exp.machine import JOB_OF
from atlantis_exp.runs.files import make_folder, no_link
from atlantis_exp.runs.folder import OUTPUT, RunFolder
from atlantis_exp.runs.journal import Journal
from atlantis_exp.sessions.job import Job
from atlantis_exp.sessions.launchers import Launcher
from atlantis_exp.sessions.stopping import sweep_goes_on

_STOP_SECONDS = 300.0  # that jobs have to commit once their sweep ends


@contextmanager
def jobs(
    journal: Journal, trainings: Sequence[Job], close_page: Callable[[], None], launcher: Launcher
) -> Iterator[None]:
    """Share the cores among the workers that the block starts, and have all jobs commit at its end."""
    from joblib.externals.loky.backend import resource_tracker as its_own

    with _shared_cores(launcher, trainings):
        for tracker in (resource_tracker, its_own):
            tracker.ensure_running()  # started later, it would lift the mask
        with _committed_at_the_end(journal, [RunFolder.of(job.config) for job in trainings], close_page):
            yield


@contextmanager
def _committed_at_the_end(
    journal: Journal, folders: Sequence[RunFolder], close_page: Callable[[], None]
) -> Iterator[None]:
    """Have all jobs commit before the sweep ends; after SIGINT or SIGTERM its exit code is a run's."""
    own = [folder for folder in folders if not folder.is_held]

    def stop() -> None:
        close_page()  # it writes the journal, too
        patience = time.monotonic() + _STOP_SECONDS
        if any(folder.is_held for folder in own):
            journal.status("KILLED")  # the jobs look at it
            while any(folder.is_held for folder in own) and time.monotonic() < patience:
                time.sleep(0.2)

    def end(number: int, _: FrameType | None) -> NoReturn:
        signal.signal(number, signal.SIG_DFL)  # a second one ends the process at once
        terminal.warn(f"{signal.Signals(number).name}: the jobs commit and end")
        stop()
        sys.exit(128 + number)

    handlers = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    # A worker that a signal ends would take all others along: they inherit the mask. The signals reach this process
    # all the same, through its other threads.
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, handlers)
    try:
        yield
    finally:
        stop()
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in handlers.items():
            signal.signal(number, handler)


@contextmanager
def _shared_cores(launcher: Launcher, trainings: Sequence[Job]) -> Iterator[None]:
    """Tell the workers their share of the cores, unless a person has."""
    if "OMP_NUM_THREADS" in os.environ:
        yield
        return
    from joblib import cpu_count, effective_n_jobs

    left = sum(RunFolder.of(job.config).ended(job.config.budget.steps) is None for job in trainings)
    at_once = min(effective_n_jobs(launcher.n_jobs), left)
    share = str(max(cpu_count() // max(at_once, 1), 1))
    os.environ |= {"OMP_NUM_THREADS": share, "MKL_NUM_THREADS": share}
    try:
        yield
    finally:
        del os.environ["OMP_NUM_THREADS"], os.environ["MKL_NUM_THREADS"]


def train_apart(job: Job) -> None:
    """Train in a process of its own. Raises: Fault where the run fails."""
    config, folder = job.config, RunFolder.of(job.config)
    if folder.ended(config.budget.steps) is not None:
        return
    if not sweep_goes_on(folder, job.launcher)():
        raise Fault(f"run {folder.name}: the sweep has ended", exit_code=128 + signal.SIGTERM)
    make_folder(folder.path)
    with open(folder.path / OUTPUT, "a+", opener=no_link) as output:
        start = output.tell()
        code = subprocess.run(
            [sys.executable, "-m", "atlantis_exp", "train", *job.overrides],
            env={**os.environ, JOB_OF: "apart"},
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            check=False,
        ).returncode
        if folder.parent and not RunFolder(folder.parent).is_held:
            os._exit(code)  # the process that this worker works for was killed: there is nobody to tell
        output.seek(start)
        said = output.read().splitlines()
    if code == 0:
        return
    reason = (
        f"killed by {signal.Signals(-code).name}"
        if code < 0
        else (said or ["it said nothing"])[-1].removeprefix("atlantis_exp: ")
    )
    if code < 0 or code == 1:
        with suppress(Fault), folder.held():
            has_said_so = code == 1 and folder.state == "failed"
            if not has_said_so and folder.ended(config.budget.steps) is None:  # else it died after its run's end
                Journal(folder.path).status("KILLED" if code < 0 else "FAILED", reason)
    raise Fault(f"run {folder.name}: {reason}; see {folder.path / OUTPUT}", exit_code=code if code > 0 else 128 - code)
