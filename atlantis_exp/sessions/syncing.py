"""Run folders and an MLflow store, brought up to each other."""

import shutil
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from atlantis_exp import terminal
from atlantis_exp.config import PathsConfig, TrackingConfig
from atlantis_exp.faults import Fault
from atlantis_exp.runs.folder import COMMIT, RunFolder, all_folders
from atlantis_exp.tracking.store import Store, StoredRun, brought, first_line, forget_lost, publish
from atlantis_exp.tracking.travel import bring, is_here, place

_CHANGES = ("brought", "published")


class Look(NamedTuple):
    """What became of one run, and why where that is no matter of course."""

    outcome: str
    run: str
    reason: str = ""


def sync(
    *,
    to: str | None,
    from_: str | None,
    every: str | int | None,
    seconds: int | None,
    tracking: TrackingConfig,
    paths: PathsConfig,
) -> None:
    """Bring runs and store up to each other, once or until interrupted; print a line a run that changed, and counts.

    Raises:
        Fault: where the store cannot be reached or a run failed; with `every`, which is so many `seconds`, that is
            said, and tried again.
    """
    outputs = Path(paths.outputs)
    store = Store(outputs, tracking.experiment, to or tracking.uri)
    source = Store(outputs, tracking.experiment, from_) if from_ else None
    is_first = True
    try:
        while True:
            try:
                if source is not None:
                    _tell(f"from {source.uri}", _bring_all(outputs, source), is_first)
                _tell(f"to {store.uri}", _publish_all(outputs, store, only_brought=source is not None), is_first)
            except Fault as fault:
                if seconds is None:
                    raise
                terminal.warn(f"{fault}; looking again in {every}")
            if seconds is None:
                return
            is_first = False
            time.sleep(seconds)
    except KeyboardInterrupt:
        sys.exit(130)  # 128 + SIGINT; whatever has arrived is noted


def _tell(way: str, looks: Iterable[Look], is_first: bool) -> None:
    """Print what became of runs; counts only at first and where something did. Raises: Fault."""
    counts: Counter[str] = Counter()
    for look in looks:
        outcome, run, reason = (terminal.harmless(text).replace("\n", " ") for text in look)  # a server's among them
        counts[outcome] += 1
        if reason:
            terminal.warn(f"{run}: {outcome}: {reason}")
        elif outcome in _CHANGES:
            print(f"  {outcome:12}{run}", flush=True)
    if is_first or any(outcome in counts for outcome in (*_CHANGES, "failed")):
        listed = ", ".join(f"{count} {outcome}" for outcome, count in sorted(counts.items()))
        print(f"{way}: {counts.total()} runs{': ' if listed else ''}{listed}", flush=True)
    if counts["failed"]:
        raise Fault(f"{way}: {counts['failed']} of {counts.total()} runs failed")


def _publish_all(outputs: Path, store: Store, only_brought: bool) -> Iterator[Look]:
    listed = {run.run_id for run in _runs(store)}
    for folder in (each.path for each in reversed(all_folders(outputs))):  # sweeps before runs, which publish theirs
        run = str(folder.relative_to(outputs))
        try:
            if only_brought and brought(folder) is None:
                continue
            forget_lost(folder, store, listed)
            with terminal.working(f"publishing {run}"):
                was_behind = publish(folder, store, is_primary=False)
            yield Look("published" if was_behind else "up to date", run)
        except Exception as error:
            yield Look("failed", run, _reason(error, store))


def _bring_all(outputs: Path, source: Store) -> Iterator[Look]:
    runs = sorted(_runs(source), key=lambda run: run.folder.parts[-2:], reverse=True)
    listed = {run.run_id for run in runs}
    for run in runs:
        try:
            folder = place(run, outputs)
            if is_here(folder, run):
                yield Look("as here", run.name)
                continue
            told = terminal.working(f"bringing {folder.relative_to(outputs)}")
            with told, _gone_unless_brought(folder), RunFolder(folder).held():
                outcome = bring(run, folder, source, listed)
            reason = f"{folder} is another run, which stays" if outcome == "other" else ""
            yield Look(outcome, str(folder.relative_to(outputs)), reason)
        except Fault as fault:
            yield Look("held", run.name, str(fault))
        except Exception as error:
            yield Look("failed", run.name, _reason(error, source))


def _runs(store: Store) -> list[StoredRun]:
    try:
        with terminal.working(f"asking {store.uri} for its runs"):
            return store.runs()
    except Exception as error:
        raise Fault(f"{store.uri} cannot be reached: {first_line(error)}") from None


@contextmanager
def _gone_unless_brought(folder: Path) -> Iterator[None]:
    """Leave no new folder where nothing is committed after the block."""
    is_new = not folder.exists()
    try:
        yield
    finally:
        if is_new and not (folder / COMMIT).exists():
            shutil.rmtree(folder, ignore_errors=True)


def _reason(error: Exception, store: Store) -> str:
    """What went wrong with one run. Raises: Fault where it is the store that did."""
    if (fault := store.fault(error)) is not None:
        raise Fault(f"{store.uri} cannot be reached: {first_line(fault)}") from None
    return first_line(error)
