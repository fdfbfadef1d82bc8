"""Run jobs on a Slurm cluster with submitit; the sweep's process submits them and waits."""

import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from atlantis_exp import terminal
from atlantis_exp.faults import Fault, in_words
from atlantis_exp.sessions.job import Job
from atlantis_exp.sessions.launchers import Launcher

_SHARED = {  # settings that submitit has for every cluster
    *("name", "timeout_min", "cpus_per_task", "gpus_per_node", "tasks_per_node", "mem_gb", "nodes", "stderr_to_stdout"),
}

Train = Callable[[Sequence[str]], None]  # trains the job of these overrides


@dataclass(frozen=True)
class _Training:
    """A job as it is pickled for a node of the cluster."""

    train: Train

    def __call__(self, overrides: Sequence[str]) -> Fault | None:
        """Train; return a failure rather than raise it, since that would count as the node's."""
        try:
            self.train(overrides)
        except (Fault, OSError) as error:
            return error if isinstance(error, Fault) else Fault(in_words(error))
        except Exception as error:
            traceback.print_exc()
            return Fault(f"{' '.join(overrides)}: {type(error).__name__}: {error}")
        return None

    def checkpoint(self, *arguments: Any) -> Any:
        """Return the job that submitit submits after a preemption or a timeout: the same one."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, *arguments)


def submit(jobs: Sequence[Job], launcher: Launcher, train: Train) -> None:
    """Submit jobs as one array and wait for all; an interrupt ends the waiting, not the jobs.

    Raises: the Fault of the first job that failed, was cancelled or was killed; Fault if Slurm rejects them.
    """
    from submitit import AutoExecutor
    from submitit.core.utils import UncompletedJobError

    settings = dict(launcher.settings)
    folder = jobs[0].outputs / "sweeps" / time.strftime("%Y-%m-%d_%H-%M-%S")
    folder.mkdir(parents=True, exist_ok=True)
    most_sessions = settings.pop("max_num_timeout")
    executor = AutoExecutor(folder / "%j", cluster="slurm", slurm_max_num_timeout=most_sessions)
    executor.update_parameters(**{key if key in _SHARED else f"slurm_{key}": value for key, value in settings.items()})
    print(f"the jobs print to {folder}", flush=True)
    faults = []
    try:
        for job in executor.map_array(_Training(train), [job.overrides for job in jobs]):
            try:
                faults.append(job.result())
            except UncompletedJobError as error:
                lines = str(error).splitlines()  # after the first two comes the job's output
                faults.append(Fault(" ".join(lines[:2])))
    except UncompletedJobError as error:  # of sbatch
        raise Fault(str(error).splitlines()[-1]) from error
    except (KeyboardInterrupt, SystemExit) as left:
        terminal.warn(f"the jobs go on; {terminal.PROGRAM} sync publishes their runs")
        sys.exit(getattr(left, "code", 128 + signal.SIGINT))
    if failed := [fault for fault in faults if fault is not None]:
        raise failed[0]
