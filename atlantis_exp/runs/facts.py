"""Read a journal's tags and files without its curves."""

import mmap
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from atlantis_exp.runs.files import open_file
from atlantis_exp.runs.journal import Artifact, Record, Tags, read, read_commit


class JournalFacts(NamedTuple):
    """The last value of each tag, and the names of the files under `artifacts/`, at the last commit."""

    tags: dict[str, str]
    artifacts: tuple[str, ...]  # each once, in order


def read_facts(folder: Path) -> JournalFacts:
    """Read a run folder's tags and the names of its files. Raises: OSError, ValueError for a damaged journal."""
    paths = (record.path for record in _records(folder, "artifact") if isinstance(record, Artifact))
    return JournalFacts(read_tags(folder), tuple(dict.fromkeys(paths)))


def read_tags(folder: Path) -> dict[str, str]:
    """Read each tag's last value. Raises: as `read_facts`."""
    commit = read_commit(folder)
    tags = dict(commit.labels) if commit else {}
    for record in _records(folder, "tags"):
        tags |= record.values if isinstance(record, Tags) else {}
    return tags


def _records(folder: Path, kind: str) -> Iterator[Record]:
    """Yield the committed records of a kind, and parse only these."""
    commit = read_commit(folder)
    if commit is None or commit.offset == 0:
        return
    with open_file(folder / "journal.jsonl") as file:
        if file.seek(0, 2) < commit.offset:
            raise ValueError(f"{file.name} ends before its commit at {commit.offset}")
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as journal:
            for start in _lines(journal, f'{{"kind":"{kind}",'.encode(), commit.offset):
                yield from (record for _, record in read(folder, start, start + 1))


def _lines(journal: mmap.mmap, opening: bytes, end: int) -> Iterator[int]:
    """Yield the offsets of the lines that start with `opening`."""
    if journal[: len(opening)] == opening:
        yield 0
    newline = journal.find(b"\n" + opening, 0, end)
    while newline >= 0:
        yield newline + 1
        newline = journal.find(b"\n" + opening, newline + 1, end)
