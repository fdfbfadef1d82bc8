"""What a journal says of its run beside the points of its curves: tags and files."""

import mmap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from atlantis_exp.runs.files import open_file
from atlantis_exp.runs.journal import Artifact, Tags, read, read_commit


@dataclass(frozen=True)
class Facts:
    """What is committed: each tag's last value, and the names of files under `artifacts/`, each once, in order."""

    tags: dict[str, str]
    artifacts: tuple[str, ...]


def read_facts(folder: Path) -> Facts:
    """Read a run folder's tags and the names of its files; other lines are passed over, however many there are.

    Raises:
        OSError, ValueError: on a journal that ends before its commit, or a line that no writer left so.
    """
    commit = read_commit(folder)
    tags: dict[str, str] = dict(commit.labels) if commit else {}
    artifacts: dict[str, None] = {}
    if commit is None or commit.offset == 0:
        return Facts(tags, ())
    with open_file(folder / "journal.jsonl") as file:
        if file.seek(0, 2) < commit.offset:
            raise ValueError(f"{file.name} ends before its commit at {commit.offset}")
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as journal:
            for kind in ("tags", "artifact"):
                for start in _lines(journal, f'{{"kind":"{kind}",'.encode(), commit.offset):
                    for _, record in read(folder, start, start + 1):
                        if isinstance(record, Tags):
                            tags |= record.values
                        elif isinstance(record, Artifact):
                            artifacts[record.path] = None
    return Facts(tags, tuple(artifacts))


def _lines(journal: mmap.mmap, opening: bytes, end: int) -> Iterator[int]:
    """Where the lines with such an opening begin."""
    if journal[: len(opening)] == opening:
        yield 0
    newline = journal.find(b"\n" + opening, 0, end)
    while newline >= 0:
        yield newline + 1
        newline = journal.find(b"\n" + opening, newline + 1, end)
