"""What a journal says of its run beside the points of its curves: tags and files."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic_core import from_json

from atlantis_exp.runs.journal import read_commit

_TAGS, _ARTIFACT = b'{"kind":"tags",', b'{"kind":"artifact",'


@dataclass(frozen=True)
class Facts:
    """What is committed: each tag's last value, and the names of files under `artifacts/`, each once, in order."""

    tags: dict[str, str]
    artifacts: tuple[str, ...]


def read_facts(folder: Path) -> Facts:
    """Read a run folder's tags and the names of its files; other lines are passed over, however many there are.

    Raises:
        ValueError: on a journal that ends before its commit, or a line that no writer left so.
    """
    commit = read_commit(folder)
    tags: dict[str, str] = dict(commit.labels) if commit else {}
    artifacts: dict[str, None] = {}
    end = commit.offset if commit else 0
    if end == 0:
        return Facts(tags, ())
    with open(folder / "journal.jsonl", "rb", buffering=1 << 20) as file:
        position = 0  # bytes
        while position < end:
            line = file.readline()
            if not line.endswith(b"\n"):
                raise ValueError(f"{file.name} ends at byte {position + len(line)}, before its commit at {end}")
            position += len(line)
            if line.startswith((_TAGS, _ARTIFACT)):
                fields: dict[str, Any] = from_json(line)
                if fields["kind"] == "tags":
                    tags |= fields["values"]
                else:
                    artifacts[fields["path"]] = None
    return Facts(tags, tuple(artifacts))
