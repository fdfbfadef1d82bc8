"""Read the environment of a process: its cores and its launcher."""

import os
from dataclasses import dataclass

JOB_OF = "ATLANTIS_EXP_JOB_OF"
"""The environment variable that tells a job its launcher."""


@dataclass(frozen=True)
class Machine:
    """A process's share of its machine, and its launcher."""

    cores: int
    launcher: str | None = None  # of the sweep, if this process is a job of one
    slurm_restarts: int | None = None  # of this job; None outside of Slurm


def all_cores() -> int:
    """Return the number of cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1  # macOS lacks it


def here() -> Machine:
    """Read this process's environment; OMP_NUM_THREADS limits its cores, as for torch, Slurm and launchers."""
    cores = all_cores()
    share, restarts = os.environ.get("OMP_NUM_THREADS", ""), os.environ.get("SLURM_RESTART_COUNT", "0")
    return Machine(
        cores=min(cores, int(share)) if share.isdecimal() and int(share) else cores,
        launcher=os.environ.get(JOB_OF),
        slurm_restarts=int(restarts) if "SLURM_JOB_ID" in os.environ else None,
    )
