"""Mirror run folders to the store while a command works, and send the rest of earlier commands."""

import logging
import os
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from atlantis_exp import terminal
from atlantis_exp.config import TrackingConfig
from atlantis_exp.faults import Fault
from atlantis_exp.runs.folder import RunFolder, all_folders
from atlantis_exp.runs.journal import Journal, read_commit
from atlantis_exp.terminal import command_line, quoted
from atlantis_exp.tracking.local import DATABASE
from atlantis_exp.tracking.mirror import PRIMARY, Cursor, digest, publish
from atlantis_exp.tracking.store import Store, first_line

_log = logging.getLogger(__name__)

_DRAIN_SECONDS = 20.0  # to wait for MLflow at a command's end; `catch_up` sends the rest later


class Publisher:
    """Publish the commits of run folders every `interval` seconds in a thread, without disturbing the runs.

    While MLflow fails, it backs off to one try a minute, or a second while a drain waits.
    """

    def __init__(self, folder: Path, store: Store, interval: float = 5.0, others: Sequence[Path] = ()) -> None:
        self._folders = (folder, *others)
        self._store = store
        self._interval = interval
        self._draining, self._awaited = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="publisher", daemon=True)
        self._thread.start()

    def drain(self, timeout: float) -> bool:
        """Publish the commits so far and stop; return False if that takes more than `timeout` seconds."""
        self._awaited.set()
        self._draining.set()
        self._thread.join(timeout)
        self._awaited.clear()
        return not self._thread.is_alive()

    def _run(self) -> None:
        delay, failing, told = self._interval, False, set[Path]()
        while True:
            draining = self._draining.is_set()  # read first: a drain publishes all commits before it
            fault: Exception | None = None  # of the store; a folder's own fault does not stop the others
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
                    _log.warning("Publishing to MLflow fails (%s); the run continues and is published later", reason)
                delay, failing = min(2 * delay, 60.0), True
            else:
                if failing:
                    _log.warning("Publishing to MLflow works again and is up to date")
                delay, failing = self._interval, False
                if draining:
                    return
            if not draining:
                self._draining.wait(delay)
            elif self._awaited.wait(delay):
                time.sleep(1.0)


@contextmanager
def publishing(
    folder: RunFolder,
    tracking: TrackingConfig,
    outputs: Path,
    labels: Mapping[str, str],
    others: Sequence[RunFolder] = (),
    seconds: float = _DRAIN_SECONDS,
) -> Iterator[Journal]:
    """Open a journal in the run's folder and mirror it to MLflow as it grows, unless tracking=none.

    labels: tags of the run from its start.
    others: runs of other processes to mirror, too.
    seconds: to wait for MLflow at the end.

    Raises:
        JournalError: the folder's journal is damaged.
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
            is_sent = publisher.drain(seconds)
        if not is_sent:
            terminal.warn(f"MLflow has not received all of {folder.name} yet; the run's folder has it")


def unfinished(folder: Path, root: Path) -> Store | None:
    """Return the store, with its files under `root`, that lacks commits of a published folder."""
    cursor, commit = Cursor.read(folder / PRIMARY), read_commit(folder)
    if cursor is None or commit is None or cursor.commit == digest(commit):
        return None
    uri, _, experiment = cursor.store.rpartition("#")
    return Store(root, experiment, uri if uri.startswith("http") else None)


def catch_up(
    outputs: Path, server: str | None = None, continued: Path | None = None, seconds: float = _DRAIN_SECONDS
) -> None:
    """Mark runs of dead processes as interrupted; publish the rest of earlier commands, each for some seconds.

    Use only the command's own `server` and the one in MLFLOW_TRACKING_URI: a folder may name any server, and that would
    receive the user's password. Leave the run in the folder `continued` to its own session.
    """
    named = {server, os.environ.get("MLFLOW_TRACKING_URI")}
    left: Counter[str] = Counter()
    unreachable: set[str] = set()
    for folder in all_folders(outputs):
        try:
            if folder.status == "RUNNING" and not folder.is_held:
                with suppress(Fault, OSError), folder.held():  # another user's folder may be read-only
                    if folder.status == "RUNNING":  # it may just have ended
                        Journal(folder.path).status("KILLED")
                        print(f"run {folder.name} was killed; repeat its command to continue it")
            is_sent = folder.status == "RUNNING" or folder.path == continued
            store = None if is_sent else unfinished(folder.path, outputs)
        except (Fault, OSError, ValueError) as error:
            terminal.warn(str(error))  # a command must not fail because of another run
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
        terminal.warn(f"{uri} lacks parts of {runs} runs; {command_line('sync', f'to={quoted(uri)}')} sends them")


def lacking(outputs: Path) -> list[RunFolder]:
    """Return the folders never published to the local store; all if it is missing."""
    folders = [folder for folder in all_folders(outputs) if (folder.path / "journal.jsonl").exists()]
    if not (outputs / DATABASE).exists():
        return folders
    store = f"{Store(outputs).uri}#"

    def is_known(folder: RunFolder) -> bool:
        cursors = map(Cursor.read, folder.path.glob("published*.json"))
        return any(cursor and cursor.store.startswith(store) for cursor in cursors)

    return [folder for folder in folders if not is_known(folder)]


def how_to_open(outputs: Path) -> str:
    """Return a paragraph with the command that opens the UI on an outputs folder; empty without runs."""
    missing = len(lacking(outputs))
    if not missing and not (outputs / DATABASE).exists():
        return ""
    shown = outputs.relative_to(Path.cwd()) if outputs.is_relative_to(Path.cwd()) else outputs
    command = command_line("ui", f"paths.outputs={quoted(shown)}")
    return f"\nthe MLflow UI: {command}{f' (publishes {missing:,} runs that it lacks first)' if missing else ''}\n"
