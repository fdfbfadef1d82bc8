"""Publish run folders to an MLflow store, once or repeatedly."""

import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from atlantis_exp import terminal
from atlantis_exp.config import PathsConfig, TrackingConfig
from atlantis_exp.faults import Fault
from atlantis_exp.runs.folder import RunFolder, all_folders
from atlantis_exp.tracking.mirror import publish
from atlantis_exp.tracking.store import Store, first_line


def sync(
    *,
    to: str | None,
    every: int | None,
    tracking: TrackingConfig,
    paths: PathsConfig,
    wait: Callable[[float], object] = time.sleep,
) -> None:
    """Publish all run folders, once or until interrupted; print changed runs and counts.

    Raises: Fault if the store cannot be reached or a run failed. With `every`, in seconds, it warns and tries again.
    """
    outputs = Path(paths.outputs)
    store = Store(outputs, tracking.experiment, to or tracking.uri)
    is_first = True
    try:
        while True:
            try:
                publish_all(outputs, store, is_first=is_first)
            except Fault as fault:
                if every is None:
                    raise
                terminal.warn(f"{fault}; trying again in {every} s")
            if every is None:
                return
            is_first = False
            wait(every)
    except KeyboardInterrupt:
        sys.exit(130)  # 128 + SIGINT; sent runs are recorded


def publish_all(
    outputs: Path, store: Store, folders: Sequence[RunFolder] | None = None, *, is_first: bool = True
) -> None:
    """Publish run folders, by default all under `outputs`; print changed ones, and counts at first or after a change.

    Raises: Fault if the store cannot be reached or a run failed.
    """
    try:
        with terminal.working(f"asking {store.uri} for its runs"):
            listed = {run.info.run_id for run in store.runs()}
    except Exception as error:
        raise store.explained(error) from None
    counts: Counter[str] = Counter()
    folders = all_folders(outputs) if folders is None else folders
    for folder in (each.path for each in reversed(folders)):  # sweeps before runs, which publish theirs
        run = terminal.harmless(str(folder.relative_to(outputs))).replace("\n", " ")
        try:
            with terminal.working(f"publishing {run}"):
                was_behind = publish(folder, store, is_primary=False, listed=listed)
        except Exception as error:
            if (fault := store.fault(error)) is not None:
                raise fault from None
            counts["failed"] += 1
            terminal.warn(f"{run}: failed: {first_line(error)}")
            continue
        counts["published" if was_behind else "up to date"] += 1
        if was_behind:
            print(f"  published   {run}", flush=True)
    if is_first or counts["published"] or counts["failed"]:
        listing = ", ".join(f"{count} {outcome}" for outcome, count in sorted(counts.items()))
        print(f"to {store.uri}: {counts.total()} runs{': ' if listing else ''}{listing}", flush=True)
    if counts["failed"]:
        raise Fault(f"to {store.uri}: {counts['failed']} of {counts.total()} runs failed")
