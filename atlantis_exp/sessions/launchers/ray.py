"""Jobs on the machines of a Ray cluster."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import Any

from atlantis_exp.runs.files import make_folder, no_link
from atlantis_exp.runs.folder import OUTPUT, RunFolder
from atlantis_exp.runs.journal import Journal
from atlantis_exp.sessions.job import Job
from atlantis_exp.sessions.launchers import Launcher, as_one_line, committed_at_the_end


@contextmanager
def jobs(
    journal: Journal, folders: Sequence[RunFolder], close_page: Callable[[], None], launcher: Launcher
) -> Iterator[None]:
    """Start Ray or join a cluster, and have all jobs commit at the end of the block."""
    _start(launcher.ray or {})
    with committed_at_the_end(journal, folders, close_page, is_masked=False):
        yield


def _start(settings: Mapping[str, Any]) -> None:
    """Start Ray before the launcher does: it puts a handler of its own on SIGTERM."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if settings.get("address") is None and "RAY_ADDRESS" not in os.environ:
        os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")  # what is started listens to 127.0.0.1 only
        settings = {**settings, "address": "local"}  # None would join the cluster of another sweep on this machine
    import ray

    ray.init(**settings)


def train_there(job: Job) -> None:
    """Train as a job of Ray's: what is printed goes to the run's folder, since Ray's own files are on any machine.

    Raises: Fault where the run fails.
    """
    from atlantis_exp.sessions.training import train  # and torch, which the sweep does without

    folder = RunFolder.of(job.config)
    make_folder(folder.path)
    with (
        open(folder.path / OUTPUT, "a", buffering=1, opener=no_link) as output,
        redirect_stdout(output),
        redirect_stderr(output),
        as_one_line(folder.name),
    ):
        train(job)
