"""Jobs side by side on this machine, each in a process of its own: if one ends, the others go on."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from types import FrameType
from typing import NoReturn

from atlantis_exp import terminal
from atlantis_exp.faults import Fault
from atlantis_exp.machine import JOB_OF, all_cores
from atlantis_exp.runs.files import make_folder, no_link
from atlantis_exp.runs.folder import OUTPUT, RunFolder
from atlantis_exp.runs.journal import Journal
from atlantis_exp.sessions.job import Job
from atlantis_exp.sessions.launchers import Launcher
from atlantis_exp.sessions.stopping import sweep_goes_on

_STOP_SECONDS = 300.0  # that jobs have to commit once their sweep ends


@contextmanager
def committed_at_the_end(
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
    try:
        yield
    finally:
        stop()
        for number, handler in handlers.items():
            signal.signal(number, handler)


def train_side_by_side(jobs: Sequence[Job], launcher: Launcher) -> None:
    """Train jobs, as many at a time as the launcher says and the cores divided among them.

    Raises:
        Fault: the first job's that failed, once all have ended.
    """
    at_once, share = shared(all_cores(), launcher.settings["n_jobs"], jobs)
    # A person's own number of threads goes before.
    environment = {"OMP_NUM_THREADS": f"{share}", "MKL_NUM_THREADS": f"{share}", **os.environ}
    with ThreadPoolExecutor(at_once, "job") as pool:
        futures = [pool.submit(train_apart, job, environment) for job in jobs]
        try:
            wait(futures)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    for future in futures:
        future.result()


def shared(cores: int, n_jobs: int, jobs: Sequence[Job]) -> tuple[int, int]:
    """Return how many jobs are trained at a time, and the cores of each.

    n_jobs: at a time; below zero, that many fewer than one a core and one more, as joblib counts them.
    """
    left = sum(RunFolder.of(job.config).ended(job.config.budget.steps) is None for job in jobs)
    at_once = max(min(n_jobs if n_jobs > 0 else cores + 1 + n_jobs, left), 1)
    return at_once, max(cores // at_once, 1)


def train_apart(job: Job, environment: Mapping[str, str]) -> None:
    """Train in a process of its own. Raises: Fault where the run fails."""
    config, folder = job.config, RunFolder.of(job.config)
    if folder.ended(config.budget.steps) is not None:
        return
    if not sweep_goes_on(folder, "joblib")():
        raise Fault(f"run {folder.name}: the sweep has ended", exit_code=128 + signal.SIGTERM)
    make_folder(folder.path)
    with open(folder.path / OUTPUT, "a+", opener=no_link) as output:
        start = output.tell()
        code = subprocess.run(
            [sys.executable, "-m", "atlantis_exp", "train", *job.overrides],
            env={**environment, JOB_OF: "joblib"},
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            check=False,
        ).returncode
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
