"""Jobs of a Slurm cluster: what the sweep's process waits for, and what a job does."""

import signal
import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager

from atlantis_exp import terminal
from atlantis_exp.faults import Fault
from atlantis_exp.sessions.job import Job

_LOOK_SECONDS = 5.0  # between two questions to Slurm


@contextmanager
def all_awaited() -> Iterator[None]:
    """Wait for the other jobs where one that was cancelled or killed ends the launcher's own waiting.

    An interrupt ends the waiting and says that the jobs go on.

    Raises:
        Fault: names that job, or says why Slurm took none.
    """
    from submitit import SlurmJob
    from submitit.core.utils import UncompletedJobError

    try:
        yield
    except UncompletedJobError as error:
        watcher = SlurmJob.watcher  # of all jobs that this process has submitted, and of their array
        jobs = watcher._registered - {job.partition("_")[0] for job in watcher._registered if "_" in job}
        while jobs - watcher._finished:
            time.sleep(_LOOK_SECONDS)
            watcher.update()
        lines = str(error).splitlines()  # behind the first two comes all that the job has printed
        raise Fault(" ".join(lines[:2]) if type(error) is UncompletedJobError else lines[-1]) from error
    except (KeyboardInterrupt, SystemExit) as left:
        terminal.warn(f"the jobs go on; {terminal.PROGRAM} sync publishes what they do")
        sys.exit(getattr(left, "code", 128 + signal.SIGINT))


def train_as_job(job: Job) -> None:
    """Train in a process that a launcher has started. Raises: Fault where the run fails."""
    from atlantis_exp.sessions.training import train  # and torch, which the sweep does without

    try:
        train(job)
    except (Fault, OSError):
        raise
    except Exception as error:  # which may not travel to the sweep's process
        traceback.print_exc()
        raise Fault(f"run {job.config.run_name()}: {type(error).__name__}: {error}") from error
