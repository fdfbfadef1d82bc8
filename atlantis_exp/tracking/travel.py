"""The way back from a server: from MLflow runs to the run folders that they were published from, byte for byte.

A folder's small files and the committed bytes of its journal travel as artifacts (see `store`), and each record of the
journal names its own file. What a server says is data: places are checked, and small files count if their hash fits.
"""

import gzip
import io
import logging
import os
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

from atlantis_exp.runs.files import ARTIFACT, SMALL, is_whole, write_file
from atlantis_exp.runs.folder import COMMIT
from atlantis_exp.runs.journal import (
    Artifact,
    Commit,
    Image,
    Model,
    commit_of,
    read,
    read_commit,
    restore,
)
from atlantis_exp.tracking.store import (
    CHUNK,
    FILES_TAG,
    ORIGIN,
    PARENT,
    PLACE,
    SMALL_FILES,
    TRAVELS,
    Cursor,
    Files,
    Store,
    StoredRun,
    brought,
    check_parents,
    files_digest,
    image_name,
    small_files,
)

_log = logging.getLogger(__name__)

_JOURNAL = f"{TRAVELS}/journal"

Outcome = Literal["brought", "ahead", "other", "growing"]
"""What became of a run: it is here now, further along here, has another's place, or has not all arrived yet."""


def place(run: StoredRun, outputs: Path) -> Path:
    """Returns the folder under `outputs` that a run belongs into. Raises: ValueError."""
    named = "/".join(run.folder.parts[-2:])
    parts = re.fullmatch(PLACE, named)
    if parts is None or parts[1] == "artifacts":  # which is MLflow's
        raise ValueError(f"it comes from {str(run.folder)!r}, which is no run folder's place")
    return outputs / named


def is_here(folder: Path, run: StoredRun) -> bool:
    """Whether a folder is exactly as far as a run on a server is. Raises: JournalError."""
    commit = read_commit(folder)
    return commit is not None and files_digest(small_files(folder, commit)) == run.tags.get(FILES_TAG)


def bring(run: StoredRun, folder: Path, store: Store, listed: Collection[str]) -> Outcome:
    """Brings a run of a server into its folder, which the caller holds, or what of it is new there.

    A folder that is further along stays as it is, and so does one of another run; one that was brought from a run that
    the server has replaced since, and was not touched here, is replaced, too. Files that the server lacks are passed
    over with a warning. Interrupted at any moment, it leaves what was there and is made good by the next attempt.

    Args:
        listed: the ids of all runs that the server has now.

    Raises:
        ValueError: on what cannot be a run folder's; the folder stays as it was.
        MlflowException, OSError: when the server cannot be reached.
    """
    files = store.files(store.client.get_run(run.run_id).info.artifact_uri)
    names = files.names(TRAVELS)
    small = {name: files.read(f"{TRAVELS}/{name}", SMALL) for name in (COMMIT, *SMALL_FILES) if name in names}
    if files_digest(small) != run.tags.get(FILES_TAG):
        return "growing"
    if COMMIT not in small:
        raise ValueError(f"the server lacks its {COMMIT}")
    commit = commit_of(small[COMMIT])
    if commit.offset > ARTIFACT:
        raise ValueError(f"its journal of {commit.offset:,} bytes is longer than {ARTIFACT:,}")
    if commit.parent and not re.fullmatch(PARENT, commit.parent):
        raise ValueError(f"its parent {commit.parent!r} is no run folder's place")
    check_parents(folder, commit.parent)
    local = _Local.of(folder, store)
    decision, start = _decide(local, commit, listed)
    if decision != "brought":
        return decision
    origin = Cursor(store.address, commit.identity, run.run_id, commit.offset, files_digest(small))
    goes_on = local.commit is not None and local.commit.identity == commit.identity
    if not goes_on:
        (folder / COMMIT).unlink(missing_ok=True)  # readers first: the journal changes under them next
        origin.save(folder / ORIGIN)
    restore(folder, start, _journal(files, start, commit.offset))
    records = (record for _, record in read(folder, start, commit.offset))
    named = {record.path: record for record in records if isinstance(record, Artifact | Image | Model)}
    _bring_files(run, folder, store, files, named)
    for name in SMALL_FILES:
        if name in small:
            write_file(folder / name, small[name])
        else:
            (folder / name).unlink(missing_ok=True)
    write_file(folder / COMMIT, small[COMMIT])
    if goes_on:  # not before: what is here until then is less than the server has, and not to be sent there
        origin.save(folder / ORIGIN)
    return "brought"


@dataclass(frozen=True)
class _Local:
    """What is in a run's folder here before anything is brought."""

    commit: Commit | None
    has_journal: bool
    was_brought: bool  # whether the folder notes a server as its origin, be it still one with the run there or not
    untouched_from: str | None  # the server's run that the folder still equals

    @classmethod
    def of(cls, folder: Path, store: Store) -> Self:
        commit, untouched_from = read_commit(folder), None
        if commit is not None and (origin := brought(folder)) is not None:
            digest = files_digest(small_files(folder, commit))
            untouched_from = origin.run_id if (origin.store, origin.files) == (store.address, digest) else None
        return cls(commit, (folder / "journal.jsonl").exists(), (folder / ORIGIN).exists(), untouched_from)


def _decide(local: _Local, remote: Commit, listed: Collection[str]) -> tuple[Outcome, int]:
    """What is to become of a run, and from which byte of its journal it is to be brought."""
    if local.commit is None:
        has_lost_its_commit = local.has_journal and not local.was_brought
        return ("other" if has_lost_its_commit else "brought"), 0
    if local.commit.identity == remote.identity:
        ours, theirs = ((commit.offset, commit.updated) for commit in (local.commit, remote))
        is_newer = local.untouched_from is not None or theirs > ours
        if remote.offset < local.commit.offset or not is_newer:
            return "ahead", 0
        return "brought", local.commit.offset
    was_replaced = local.untouched_from is not None and local.untouched_from not in listed
    return ("brought" if was_replaced else "other"), 0


def _journal(files: Files, start: int, end: int) -> Iterator[bytes]:
    """The bytes of a journal between two offsets; the server's pieces may overlap, since they may be sent again."""
    named = (re.fullmatch(r"(\d{12})\.gz", name) for name in files.names(_JOURNAL))
    begins = sorted((int(name[1]) for name in named if name), reverse=True)
    while start < end:
        for begin in (begin for begin in begins if start - CHUNK < begin <= start):
            with gzip.GzipFile(fileobj=io.BytesIO(files.read(f"{_JOURNAL}/{begin:012d}.gz", 2 * CHUNK))) as packed:
                piece = packed.read(CHUNK)[start - begin : end - begin]
            if piece:
                break
        else:
            raise ValueError(f"the server lacks its journal from byte {start} on")
        yield piece
        start += len(piece)


def _bring_files(
    run: StoredRun, folder: Path, store: Store, files: Files, named: Mapping[str, Artifact | Image | Model]
) -> None:
    """Write the files that records name, by path."""
    has_models = any(isinstance(record, Model) for record in named.values())
    models = {model.tags.get("step"): model for model in store.models(run.run_id)} if has_models else {}
    listed: dict[str, set[str]] = {}  # folders, and what lies in them
    for path, record in named.items():
        if isinstance(record, Model):
            model = models.get(str(record.step))
            content = store.files(model.artifact_location).read(os.path.basename(path), ARTIFACT) if model else None
        else:
            there = f"{image_name(run.run_id, record)}.png" if isinstance(record, Image) else path
            above, name = os.path.split(there)
            if above not in listed:
                listed[above] = files.names(above)
            content = files.read(there, ARTIFACT) if name in listed[above] else None
        if isinstance(record, Model) and content is not None and not is_whole(content, record.sha256):
            raise ValueError(f"{path} does not have the checksum that its journal gives it")
        if content is None:
            _log.warning("%s is not on the server and cannot be brought", folder / "artifacts" / path)
        else:
            write_file(folder / "artifacts" / path, content)
