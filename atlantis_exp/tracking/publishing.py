"""Run folders and the store while a command works: mirrored as they grow, and what earlier commands left is sent."""

import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from shlex import quote

from atlantis_exp import terminal
from atlantis_exp.config import TrackingConfig
from atlantis_exp.faults import Fault
from atlantis_exp.runs.folder import RunFolder, all_folders
from atlantis_exp.runs.journal import Journal
from atlantis_exp.terminal import PROGRAM
from atlantis_exp.tracking.store import DATABASE, Publisher, Store, brought, unfinished

_DRAIN_SECONDS = 20.0  # that a command waits for MLflow at its end; `catch_up` sends what is missing then


@contextmanager
def publishing(
    folder: RunFolder,
    tracking: TrackingConfig,
    outputs: Path,
    labels: Mapping[str, str],
    others: Sequence[RunFolder] = (),
) -> Iterator[Journal]:
    """A journal in the run's folder that is mirrored to MLflow while it grows (tracking=mlflow).

    labels: tags that the run bears from its first moment.
    others: runs that other processes write and that are mirrored too.

    Raises:
        JournalError: where the folder's journal is damaged.
    """
    journal = Journal(folder.path, labels)
    if tracking.name == "none":
        yield journal
        return
    store = Store(outputs, tracking.experiment, tracking.uri)
    publisher = Publisher(folder.path, store, others=[other.path for other in others])
    try:
        yield journal
    finally:
        with terminal.working("publishing to MLflow"):
            is_sent = publisher.drain(_DRAIN_SECONDS)
        if not is_sent:
            terminal.warn(f"MLflow has not taken all of {folder.name} yet; the run's folder has it")


def catch_up(outputs: Path, server: str | None = None, continued: Path | None = None) -> None:
    """Mark runs whose process died as interrupted; publish what earlier commands could not.

    A folder's word for a server is not enough, since it would be sent the user's password: only the command's own
    `server` is sent to, and the one that MLFLOW_TRACKING_URI names. Not published is the run in the folder `continued`,
    whose own session will do so.
    """
    named = {server, os.environ.get("MLFLOW_TRACKING_URI")}
    left: Counter[str] = Counter()
    unreachable: set[str] = set()
    for folder in all_folders(outputs):
        try:
            if _runs_here(folder) and not folder.is_held:
                with suppress(Fault, OSError), folder.held():  # a folder of somebody else's may be read alone
                    if _runs_here(folder):  # its process may just have ended it
                        Journal(folder.path).status("KILLED")
                        print(f"run {folder.name} was killed; the command that started it continues it")
            is_sent = folder.status == "RUNNING" or folder.path == continued
            store = None if is_sent else unfinished(folder.path, outputs)
        except (Fault, OSError, ValueError) as error:
            terminal.warn(str(error))  # no reason to refuse a command for another run
            continue
        if store is None or store.address in unreachable:
            continue
        if not store.is_local and store.uri not in named:
            left[store.uri] += 1
            continue
        with terminal.working(f"publishing {folder.name}, which an earlier command could not"):
            if not Publisher(folder.path, store).drain(_DRAIN_SECONDS):
                unreachable.add(store.address)
    for uri, runs in left.items():
        terminal.warn(f"{uri} lacks parts of {runs} runs; {PROGRAM} sync {quote(f'to={uri}')} sends them")


def _runs_here(folder: RunFolder) -> bool:
    return folder.status == "RUNNING" and not brought(folder.path)


def how_to_open(outputs: Path) -> str:
    """A paragraph that says what starts the UI on the store of an outputs folder; empty where there is no store."""
    if not (outputs / DATABASE).exists():
        return ""
    shown = outputs.relative_to(Path.cwd()) if outputs.is_relative_to(Path.cwd()) else outputs
    return f"\nthe MLflow UI: {PROGRAM} ui paths.outputs={shown}\n"
