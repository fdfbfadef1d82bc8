"""Jobs side by side on this machine, each in a process of its own: if one ends, the others go on."""

import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
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


class _Running:
    """The processes of the jobs under way."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        self.environment = environment
        self.has_ended = False
        self.processes: set[subprocess.Popen[str]] = set()

    def end(self, number: int, _: FrameType | None) -> NoReturn:
        """Have the jobs commit and end on a signal; a second one ends this process at once."""
        signal.signal(number, signal.SIG_DFL)
        self.has_ended = True
        terminal.warn(f"{signal.Signals(number).name}: the jobs commit and end")
        for process in [*self.processes]:
            process.terminate()
        sys.exit(128 + number)


def train_side_by_side(jobs: Sequence[Job], launcher: Launcher) -> None:
    """Train jobs, as many at a time as the launcher says and the cores divided among them.

    Raises:
        Fault: the first job's that failed, once all have ended.
    """
    at_once, share = shared(all_cores(), launcher.settings["n_jobs"], jobs)
    # A person's own number of threads goes before.
    running = _Running({"OMP_NUM_THREADS": f"{share}", "MKL_NUM_THREADS": f"{share}", **os.environ, JOB_OF: "joblib"})
    handlers = {number: signal.signal(number, running.end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with ThreadPoolExecutor(at_once, "job") as pool:  # ends when its jobs have
            futures = [pool.submit(_train_apart, job, running) for job in jobs]
            wait(futures)
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    for future in futures:
        future.result()


def shared(cores: int, n_jobs: int, jobs: Sequence[Job]) -> tuple[int, int]:
    """Return how many jobs are trained at a time, and the cores of each.

    n_jobs: at a time; below zero, that many fewer than one a core and one more, as joblib counts them.
    """
    left = sum(RunFolder.of(job.config).ended(job.config.budget) is None for job in jobs)
    at_once = max(min(n_jobs if n_jobs > 0 else cores + 1 + n_jobs, left), 1)
    return at_once, max(cores // at_once, 1)


def _train_apart(job: Job, running: _Running) -> None:
    """Train in a process of its own. Raises: Fault where the run fails."""
    config, folder = job.config, RunFolder.of(job.config)
    if folder.ended(config.budget) is not None:
        return
    make_folder(folder.path)
    with open(folder.path / OUTPUT, "a+", opener=no_link) as output:
        start = output.tell()
        if running.has_ended:
            raise Fault(f"run {folder.name}: the sweep has ended", exit_code=128 + signal.SIGTERM)
        command = [sys.executable, "-m", "atlantis_exp", "train", *job.overrides]
        process = subprocess.Popen(
            command, env=running.environment, stdin=subprocess.DEVNULL, stdout=output, stderr=output, text=True
        )
        running.processes.add(process)
        if running.has_ended:  # meanwhile
            process.terminate()
        code = process.wait()
        running.processes.discard(process)
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
            if not has_said_so and folder.ended(config.budget) is None:  # else it died after its run's end
                Journal(folder.path).status("KILLED" if code < 0 else "FAILED", reason)
    raise Fault(f"run {folder.name}: {reason}; see {folder.path / OUTPUT}", exit_code=code if code > 0 else 128 - code)
