"""What the environment of a process says of it: how many cores it has, and which launcher has started it."""

import os
from dataclasses import dataclass

JOB_OF = "ATLANTIS_EXP_JOB_OF"
"""The environment variable by which a launcher's worker names the launcher to the process that trains its job."""


@dataclass(frozen=True)
class Machine:
    """The share of a machine that a process has, and what has started it."""

    cores: int
    launcher: str | None = None  # whose worker has left one job of a sweep to this process
    slurm_restarts: int | None = None  # of this job; None outside of Slurm


def all_cores() -> int:
    """Return how many cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1  # macOS has none


def here() -> Machine:
    """Read this process's environment.

    Its cores are its share of all in OMP_NUM_THREADS, where launchers and Slurm's scripts say it and where torch looks
    for its threads.
    """
    cores = all_cores()
    share, restarts = os.environ.get("OMP_NUM_THREADS", ""), os.environ.get("SLURM_RESTART_COUNT", "0")
    return Machine(
        cores=min(cores, int(share)) if share.isdecimal() and int(share) else cores,
        launcher=os.environ.get(JOB_OF),
        slurm_restarts=int(restarts) if "SLURM_JOB_ID" in os.environ else None,
    )
