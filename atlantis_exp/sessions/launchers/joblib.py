"""Run jobs side by side on this machine, each in its own process: if one fails, the others go on."""

import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from types import FrameType
from typing import NoReturn

import psutil

from atlantis_exp import terminal
from atlantis_exp.build import choose_device
from atlantis_exp.config import Config
from atlantis_exp.faults import Fault
from atlantis_exp.interrupts import handled
from atlantis_exp.machine import JOB_OF, all_cores, here
from atlantis_exp.runs.files import make_folder, no_link
from atlantis_exp.runs.folder import OUTPUT, RunFolder, has_ended
from atlantis_exp.runs.journal import Journal
from atlantis_exp.sessions.job import Job
from atlantis_exp.sessions.launchers import BASIC, Launcher

_ON_A_GPU = 4  # trainings that share one without loss: docs/performance.md
_PROCESS_BYTES = 2**30  # of memory that a training takes besides its replay memory
_LAST_BYTES = 10_000  # of a job's output, whose last line says why it failed
_COMPRESSED = 8  # least compression of observations, also of whole screens


class _Running:
    """The processes of running jobs."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        self.environment = environment
        self.has_ended = False
        self.processes: set[subprocess.Popen[str]] = set()

    def end(self, number: int, _: FrameType | None) -> NoReturn:
        """Let the jobs commit and end on a signal; a second signal ends this process at once."""
        signal.signal(number, signal.SIG_DFL)
        self.has_ended = True
        terminal.warn(f"{signal.Signals(number).name}: the jobs commit and end")
        for process in [*self.processes]:
            process.terminate()
        sys.exit(128 + number)


def fitting(jobs: Sequence[Job], planned: int) -> Launcher:
    """Return a launcher for as many jobs at a time as this machine runs well; the basic one for one on all cores.

    planned: number of jobs in the whole sweep or look, including ended ones.
    """
    configs = [job.config for job in jobs]
    on_gpu = any(choose_device(config.device).type != "cpu" for config in configs)
    memory = psutil.virtual_memory()
    at_once, cores = fitted(configs, planned, all_cores(), here().cores, memory.total, memory.available, on_gpu)
    return BASIC if at_once == 1 and cores == here().cores else Launcher("joblib", {"n_jobs": at_once, "cores": cores})


def fitted(
    configs: Sequence[Config], planned: int, cores: int, own: int, memory: int, free: int, on_gpu: bool
) -> tuple[int, int]:
    """Return how many trainings a machine runs well at a time, and the cores of each.

    One core each trains the most seeds per hour; `threads`, `env.workers` or OMP_NUM_THREADS may ask for more. All
    planned trainings that the machine's memory holds share the cores, not those left nor those that fit now, so that a
    continued one keeps its number of cores, on which its last bits depend.

    own: cores by OMP_NUM_THREADS, or all if it is not set.
    memory, free: bytes, in all and available.
    """
    asked = [config.threads or 1 for config in configs] + [config.env.workers or 1 for config in configs]
    each = max([own if own < cores else 1, *asked])
    most = max(map(_memory, configs))
    sharing = max(1, min([planned, cores // each, memory // most, *([_ON_A_GPU] if on_gpu else [])]))
    at_once = max(1, min(sharing, free // most))
    return at_once, own if own < cores else cores // sharing


def _memory(config: Config) -> int:
    """Return the most bytes that a training takes with a network no larger than the built-in ones."""
    lengths = [phase.steps or config.replay.capacity for phase in config.phase.values()]
    observations = min(config.replay.capacity, sum(lengths), config.budget.steps or config.replay.capacity)
    return _PROCESS_BYTES + min(config.replay.max_bytes, observations * config.env.size**2 // _COMPRESSED)


def train_side_by_side(jobs: Sequence[Job], launcher: Launcher) -> None:
    """Train as many jobs at a time as the launcher says. Raises: the first job's Fault, once all have ended."""
    at_once, share = shared(all_cores(), launcher.settings["n_jobs"], jobs)
    # OMP_NUM_THREADS may lower a job's share, but not raise it to the whole machine.
    share = min(launcher.settings.get("cores", share), here().cores)
    threads = {"OMP_NUM_THREADS": f"{share}", "MKL_NUM_THREADS": f"{share}"}
    running = _Running({**os.environ, **threads, JOB_OF: "joblib"})
    with handled(running.end, signal.SIGINT, signal.SIGTERM), ThreadPoolExecutor(at_once, "job") as pool:
        futures = [pool.submit(_train_apart, job, running) for job in jobs]
        wait(futures)
    for future in futures:
        future.result()


def shared(cores: int, n_jobs: int, jobs: Sequence[Job]) -> tuple[int, int]:
    """Return how many jobs are trained at a time, and the cores of each.

    n_jobs: at a time; -1 for one per core, -2 for one fewer, as in joblib.
    """
    left = sum(not has_ended(job.config) for job in jobs)
    at_once = max(min(n_jobs if n_jobs > 0 else cores + 1 + n_jobs, left), 1)
    return at_once, max(cores // at_once, 1)


def _train_apart(job: Job, running: _Running) -> None:
    """Train in a process of its own. Raises: Fault where the run fails."""
    config, folder = job.config, RunFolder.of(job.config)
    if has_ended(config):
        return
    make_folder(folder.path)
    with open(folder.path / OUTPUT, "a+", errors="replace", opener=no_link) as output:
        start = output.tell()
        if running.has_ended:
            raise Fault(f"run {folder.name}: the sweep has ended", exit_code=128 + signal.SIGTERM)
        command = [sys.executable, "-m", "atlantis_exp", "train", *job.overrides]
        process = subprocess.Popen(
            command, env=running.environment, stdin=subprocess.DEVNULL, stdout=output, stderr=output, text=True
        )
        running.processes.add(process)
        if running.has_ended:  # since the process started
            process.terminate()
        code = process.wait()
        running.processes.discard(process)
        if code == 0:
            return
        output.seek(max(start, output.seek(0, os.SEEK_END) - _LAST_BYTES))
        said = output.read().splitlines()
    reason = (
        f"killed by {signal.Signals(-code).name}"
        if code < 0
        else (said or ["it printed nothing"])[-1].removeprefix("atlantis_exp: ")
    )
    if code < 0 or code == 1:
        with suppress(Fault), folder.held():
            has_said_so = code == 1 and folder.state == "failed"
            if not has_said_so and not has_ended(config):  # else the process died after its run had ended
                Journal(folder.path).status("KILLED" if code < 0 else "FAILED", reason)
    raise Fault(f"run {folder.name}: {reason}; see {folder.path / OUTPUT}", exit_code=code if code > 0 else 128 - code)
