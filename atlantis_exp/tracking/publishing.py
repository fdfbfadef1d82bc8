"""Run folders and the store while a command works: mirrored as they grow, and what earlier commands left is sent."""

import logging
import os
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from shlex import quote

from atlantis_exp import terminal
from atlantis_exp.config import TrackingConfig
from atlantis_exp.faults import Fault
from atlantis_exp.runs.folder import RunFolder, all_folders
from atlantis_exp.runs.journal import Journal, read_commit
from atlantis_exp.terminal import PROGRAM
from atlantis_exp.tracking.local import DATABASE
from atlantis_exp.tracking.mirror import PRIMARY, Cursor, digest, noted, publish
from atlantis_exp.tracking.store import Store, first_line

_log = logging.getLogger(__name__)

_DRAIN_SECONDS = 20.0  # that a command waits for MLflow at its end; `catch_up` sends what is missing then


class Publisher:
    """A thread that keeps MLflow up to date with a run folder's commits, and with others', and never disturbs the runs.

    It looks at the folders every `interval` seconds; while MLflow fails, less and less often, down to once a minute.
    """

    def __init__(self, folder: Path, store: Store, interval: float = 5.0, others: Sequence[Path] = ()) -> None:
        self._folders = (folder, *others)
        self._store = store
        self._interval = interval
        self._draining = threading.Event()
        self._thread = threading.Thread(target=self._run, name="publisher", daemon=True)
        self._thread.start()

    def drain(self, timeout: float) -> bool:
        """Publish what is committed by now and stop; return False if that took more than `timeout` seconds.

        What is left then is published while the process lives, and by `publish` later.
        """
        self._draining.set()
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        delay, failing, told = self._interval, False, set[Path]()
        while True:
            draining = self._draining.is_set()  # asked first: what is committed before a drain is published by it
            fault: Exception | None = None  # of the store; a folder's own is no reason to skip the others, or to wait
            for folder in self._folders:
                try:
                    publish(folder, self._store)
                except Exception as error:
                    if (fault := self._store.fault(error)) is not None:
                        break
                    if folder not in told:
                        told.add(folder)
                        place = terminal.harmless("/".join(folder.parts[-2:]))
                        _log.warning("%s cannot be published (%s)", place, first_line(error))
            if fault is not None:
                if not failing:
                    reason = first_line(fault)
                    _log.warning("Publishing to MLflow fails (%s); the run goes on and is published later", reason)
                delay, failing = min(2 * delay, 60.0), True
            else:
                if failing:
                    _log.warning("Publishing to MLflow works again and is up to date")
                delay, failing = self._interval, False
                if draining:
                    return
            if draining:
                time.sleep(1.0)
            else:
                self._draining.wait(delay)


@contextmanager
def publishing(
    folder: RunFolder,
    tracking: TrackingConfig,
    outputs: Path,
    labels: Mapping[str, str],
    others: Sequence[RunFolder] = (),
) -> Iterator[Journal]:
    """Open a journal in the run's folder and mirror it to MLflow while it grows (tracking=mlflow).

    labels: tags that the run bears from its first moment.
    others: runs that other processes write and that are mirrored too.

    Raises:
        JournalError: if the folder's journal is damaged.
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


def unfinished(folder: Path, root: Path) -> Store | None:
    """Return the store, with its files under `root`, that lacks a part of what a published folder has committed."""
    cursor, commit = Cursor.read(folder / PRIMARY), read_commit(folder)
    if cursor is None or commit is None or cursor.commit == digest(commit):
        return None
    uri, _, experiment = cursor.store.rpartition("#")
    return Store(root, experiment, uri if uri.startswith("http") else None)


def catch_up(
    outputs: Path, server: str | None = None, continued: Path | None = None, seconds: float = _DRAIN_SECONDS
) -> None:
    """Mark runs whose process died as interrupted; publish what earlier commands could not, each for some seconds.

    A folder's word for a server is not enough, since it would be sent the user's password: only the command's own
    `server` is sent to, and the one that MLFLOW_TRACKING_URI names. Not published is the run in the folder `continued`,
    whose own session will do so.
    """
    named = {server, os.environ.get("MLFLOW_TRACKING_URI")}
    left: Counter[str] = Counter()
    unreachable: set[str] = set()
    for folder in all_folders(outputs):
        try:
            if folder.status == "RUNNING" and not folder.is_held:
                with suppress(Fault, OSError), folder.held():  # a folder of somebody else's may be read alone
                    if folder.status == "RUNNING":  # its process may just have ended it
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
            if not Publisher(folder.path, store).drain(seconds):
                unreachable.add(store.address)
    for uri, runs in left.items():
        terminal.warn(f"{uri} lacks parts of {runs} runs; {PROGRAM} sync {quote(f'to={uri}')} sends them")


def lacking(outputs: Path) -> list[RunFolder]:
    """Return the folders that were never published in the local store, all if it is gone."""
    folders = [folder for folder in all_folders(outputs) if (folder.path / "journal.jsonl").exists()]
    if not (outputs / DATABASE).exists():
        return folders
    store = f"{Store(outputs).uri}#"
    return [folder for folder in folders if not any(note.store.startswith(store) for note in noted(folder.path))]


def how_to_open(outputs: Path) -> str:
    """Return a paragraph that says how to open the UI on the store of an outputs folder, empty if there is no run."""
    missing = len(lacking(outputs))
    if not missing and not (outputs / DATABASE).exists():
        return ""
    shown = outputs.relative_to(Path.cwd()) if outputs.is_relative_to(Path.cwd()) else outputs
    command = f"{PROGRAM} ui {quote(f'paths.outputs={shown}')}"
    return f"\nthe MLflow UI: {command}{f' (publishes {missing:,} runs that it lacks first)' if missing else ''}\n"
