"""Read the environment of a process: its cores and its launcher."""

import os
import re
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
    return Machine(
        cores=min(cores, _count("OMP_NUM_THREADS") or cores),
        launcher=os.environ.get(JOB_OF),
        slurm_restarts=_count("SLURM_RESTART_COUNT") if "SLURM_JOB_ID" in os.environ else None,
    )


def _count(variable: str) -> int:
    """Return an environment variable's number; 0 if it has none."""
    text = os.environ.get(variable, "")
    return int(text) if re.fullmatch(r"\d{1,6}", text) else 0
