"""Write and read a run's journal, whose records are durable and appear exactly once.

A run folder has `journal.jsonl` (one record a line), `artifacts/` (the files of records) and `commit.json` (the
journal's committed length). `Journal.state_dict` makes lines durable, and `Journal.commit` makes them visible once a
checkpoint has that state. A resumed run repeats later steps and journals them again, so nothing appears twice.
"""

import hashlib
import json
import os
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, Literal, get_args
from uuid import uuid4

from atlantis_exp.faults import Fault
from atlantis_exp.runs.files import (
    SMALL,
    Natural,
    inside,
    make_folder,
    no_link,
    open_file,
    read_file,
    read_object,
    schema_of,
    write_file,
)

Status = Literal["SCHEDULED", "RUNNING", "FINISHED", "FAILED", "KILLED"]
NOTE_LENGTH = 7_900  # characters; MLflow silently cuts a description at 8,000
NOTE = "mlflow.note.content"
"""The tag that MLflow shows as markdown at the top of a run's page."""


@dataclass(frozen=True)
class Metrics:
    """Values measured at one step; `time`, in ms since 1970, never decreases along a journal."""

    step: int
    time: int
    values: dict[str, float]


@dataclass(frozen=True)
class Params:
    """The settings of the run."""

    values: dict[str, str]


@dataclass(frozen=True)
class Tags:
    """Facts about the run; a later value replaces an earlier one."""

    values: dict[str, str]


@dataclass(frozen=True)
class Artifact:
    """A file under `artifacts/`, with its SHA-256, since the one on disk may be newer than the last commit."""

    path: str
    sha256: str = ""  # empty in journals of 0.1.0


@dataclass(frozen=True)
class Image:
    """A PNG under `artifacts/` at one position, which MLflow calls a step, of the slider of `key`."""

    key: str
    step: int
    time: int
    path: str


@dataclass(frozen=True)
class Model:
    """Weights as safetensors under `artifacts/`, with their metrics and the file's SHA-256."""

    name: str
    step: int
    time: int
    path: str
    values: dict[str, float]
    best: bool = False  # of all of its name so far
    sha256: str = ""  # empty in journals of 0.1.0


Record = Metrics | Params | Tags | Artifact | Image | Model
_KINDS: dict[str, type[Record]] = {kind.__name__.lower(): kind for kind in get_args(Record)}


@dataclass(frozen=True)
class Commit:
    """The committed length of a journal and the state of its run.

    `identity` is unique to the run and changes when the journal drops committed lines; `started` and `updated` are in
    ms since 1970, `offset` in bytes. `labels` are tags that a run has from its start, even if it fails before its first
    commit; `error` is the reason of a failure; `parent` is the relative path of the run above it in MLflow.
    """

    identity: str
    started: Natural
    updated: Natural
    offset: Natural
    status: Status
    error: str = ""
    labels: dict[str, str] = field(default_factory=dict)
    parent: str = ""


class JournalError(Fault, ValueError):
    """A damaged journal."""


_POINT_BYTES = 2_000  # between two points of `curve`; about three lines of a journal


class Journal:
    """The journal of a run folder, which has one writer at a time.

    Without `load_state_dict` it starts an empty journal, even in a folder that has one.

    Raises:
        JournalError: `commit.json` or a line is damaged, or the journal was cut or replaced meanwhile.
        ValueError: a path leads out of `artifacts/`.
        OSError: the disk refuses; durable lines stay, and a later `state_dict` writes the rest.
    """

    def __init__(self, folder: Path, labels: Mapping[str, str] | None = None) -> None:
        make_folder(folder)
        self._folder = folder
        self._time = _now()  # ms, of the latest metrics
        self._offset = 0  # durable bytes of the state
        self._noted: str | None = None
        self._lines: list[bytes] = []  # since the last checkpoint: a resumed run repeats them, so memory suffices
        commit = read_commit(folder) or _new_commit()
        if commit.status == "SCHEDULED":
            commit = replace(commit, started=self._time, status="RUNNING")
        self._commit = replace(commit, labels={**commit.labels, **(labels or {})})

    def resume(self) -> bool:
        """Continue after the last commit, without a checkpoint; return whether there is one."""
        if not self._commit.offset:
            return False
        self.load_state_dict({"offset": self._commit.offset, "time": self._commit.updated})
        return True

    def recover(self) -> None:
        """Commit all whole lines of an ended run whose `commit.json` was removed."""
        with open_file(self._folder / "journal.jsonl") as file:
            self._offset = sum(len(line) for line in iter(partial(file.readline, SMALL), b"") if line.endswith(b"\n"))
        self.commit()
        self.status("FINISHED")

    def metrics(self, values: Mapping[str, float], step: int) -> None:
        """Record values measured at a step."""
        self._time = max(self._time, _now())
        self._append(Metrics(step, self._time, _numbers(values)))

    def params(self, values: Mapping[str, str]) -> None:
        """Record the settings of the run."""
        self._append(Params(dict(values)))

    def tags(self, values: Mapping[str, str]) -> None:
        """Record facts about the run."""
        self._append(Tags(dict(values)))

    def note(self, markdown: str) -> None:
        """Describe the run so far in markdown, unless that is the last note; the last one counts."""
        if markdown != self._noted:
            self.tags({NOTE: markdown})
            self._noted = markdown

    def artifact(self, path: str, content: bytes) -> None:
        """Keep a file under a relative path; the last content of a path counts."""
        self._append(Artifact(path, self._write(path, content)))

    def image(self, key: str, content: bytes, step: int) -> None:
        """Keep a PNG at a position of its key's slider; MLflow shows runs with equal positions side by side."""
        path = f"images/{key}/{step}.png"
        self._write(path, content)
        self._append(Image(key, step, self._time, path))

    def model(self, name: str, content: bytes, step: int, metrics: Mapping[str, float], best: bool = False) -> None:
        """Keep weights (safetensors) of a step and their metrics; `best` of all with the name so far."""
        path = model_file(name, step)
        digest = self._write(path, content)
        # MLflow charts a model's metrics on the run, too: with the time of the last metrics they coincide.
        self._append(Model(name, step, self._time, path, _numbers(metrics), best, digest))

    def status(self, status: Status, error: str = "") -> None:
        """Make the run's state and the reason of a failure visible, but no records."""
        self._mark(replace(self._commit, status=status, error=error))

    def commit(self) -> None:
        """Make all records of the latest state visible; call it when a checkpoint with that state is durable."""
        self._mark(replace(self._commit, offset=self._offset))

    def flush(self) -> None:
        """Make all records durable and visible, without a checkpoint."""
        self.state_dict()
        self.commit()

    def finish(self) -> None:
        """Make all records durable and visible, and mark the run as finished."""
        self.flush()
        self.status("FINISHED")

    def state_dict(self) -> dict[str, Any]:
        """Make all records durable and return their end."""
        if self._offset < self._commit.offset:
            self._mark(replace(self._commit, offset=self._offset))  # tell readers before the bytes change
        content = b"".join(self._lines)
        _write_from(self._folder, self._offset, content)
        self._offset += len(content)
        self._lines.clear()
        return {"offset": self._offset, "time": self._time}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go back to the state's end and forget later records."""
        path = self._folder / "journal.jsonl"
        try:
            if path.stat().st_size < state["offset"]:
                raise ValueError(f"{path} is shorter than in the checkpoint: it was cut or replaced since")
            deque(read(self._folder, end=state["offset"]), maxlen=0)
        except ValueError as error:
            advice = "restore it, or start over with resume=never, which keeps the old run"
            raise JournalError(f"{error}; {advice}") from None
        self._offset, self._time, self._noted = state["offset"], state["time"], None
        self._lines.clear()

    def _write(self, path: str, content: bytes) -> str:
        """Write an artifact; return its SHA-256."""
        write_file(inside(self._folder / "artifacts", path), content)
        return hashlib.sha256(content).hexdigest()

    def _append(self, record: Record) -> None:
        line = _encode({"kind": type(record).__name__.lower(), **vars(record)})
        self._lines.append(line.encode() + b"\n")

    def _mark(self, commit: Commit) -> None:
        # Sent records cannot be recalled: a journal that goes back behind its commit is a new run for its readers.
        identity = self._commit.identity if commit.offset >= self._commit.offset else uuid4().hex
        # A clock may have been set back: no run ends before it began.
        self._commit = replace(commit, identity=identity, updated=max(_now(), self._time, self._commit.updated))
        _write_commit(self._folder, self._commit)


def read_commit(folder: Path) -> Commit | None:
    """Return a run folder's last commit, or None before its first commit or status. Raises: JournalError."""
    path = folder / "commit.json"
    try:
        return schema_of(Commit).validate_json(read_file(path, SMALL), strict=True) if path.exists() else None
    except ValueError:
        raise JournalError(f"{path} is damaged: remove it and repeat the run's command") from None


def has_lost_commit(folder: Path) -> bool:
    """Return whether a run folder has a journal but lost its `commit.json`. Raises: JournalError if it is damaged."""
    commit, path = read_commit(folder), folder / "journal.jsonl"
    is_new = commit is None or (commit.status == "SCHEDULED" and not commit.offset)  # as a sweep recreates it
    return is_new and path.exists() and path.stat().st_size > 0


def commit_bytes(commit: Commit) -> bytes:
    return _encode(asdict(commit)).encode()


def model_file(name: str, step: int) -> str:
    """Return the name of the artifact with a model's weights at a step."""
    return f"models/{name}/{step}.safetensors"


def adopt(folder: Path, parent: Path) -> None:
    """Put a run, started or not, under another one, while nobody writes its folder. Raises: JournalError."""
    make_folder(folder)
    commit = read_commit(folder) or _new_commit()
    adopted = replace(commit, parent=os.path.relpath(parent, folder))
    if adopted != commit:
        _write_commit(folder, adopted)


def _write_from(folder: Path, start: int, content: bytes) -> None:
    """Replace the journal after an offset, durably. Raises: JournalError, OSError."""
    with open(folder / "journal.jsonl", "ab", opener=no_link) as file:
        if os.fstat(file.fileno()).st_size < start:  # truncating would fill the gap with zeros
            raise JournalError(f"{file.name} is shorter than its writer left it: it was cut or replaced since")
        file.truncate(start)
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def read(folder: Path, start: int = 0, end: int | None = None) -> Iterator[tuple[int, Record]]:
    """Yield the records between two offsets in bytes, by default up to the last commit, each with its end.

    Raises:
        ValueError: the journal ends before `end`, a line is not a record, or a path leads out of `artifacts/`.
    """
    if end is None:
        commit = read_commit(folder)
        end = commit.offset if commit else 0
    if start >= end:
        return
    with open_file(folder / "journal.jsonl") as file:
        file.seek(start)
        while start < end:
            line = _line(file, start, end)
            record = record_of(line, f"{file.name}, byte {start}")
            if isinstance(record, Artifact | Image | Model):
                inside(folder / "artifacts", record.path)
            start += len(line)
            yield start, record


def record_of(line: bytes, where: str) -> Record:
    """Return the record in a line of a journal. Raises: ValueError that names the place."""
    try:
        fields = read_object(line)
        return schema_of(_KINDS[fields.pop("kind")]).validate_python(fields)
    except (ValueError, KeyError, TypeError):  # among them pydantic's, of several lines
        raise ValueError(f"{where}: not a journal record: {line[:60]!r}") from None


def curve(folder: Path, keys: Sequence[str], points: int = 500) -> Iterator[Metrics]:
    """Yield the committed metrics that have all keys; about `points` of a long journal, in constant time.

    From a journal of over 2,000 bytes a point it takes the first point of each of equal stretches, and the last of all.

    Raises:
        ValueError: as `read`.
    """
    commit = read_commit(folder)
    end = commit.offset if commit else 0
    if end <= points * _POINT_BYTES:
        for _, record in read(folder):
            if isinstance(record, Metrics) and record.values.keys() >= set(keys):
                yield record
        return
    with open_file(folder / "journal.jsonl") as file:
        last = 0  # bytes, the end of the latest point
        for stretch in range(points):
            start, stop = stretch * end // points, (stretch + 1) * end // points
            if point := next(_points(file, keys, start, stop), None):
                last, record = point
                yield record
        *_, point = (None, *_points(file, keys, last, end))
        if point:
            yield point[1]


def _points(file: BinaryIO, keys: Sequence[str], start: int, stop: int) -> Iterator[tuple[int, Metrics]]:
    """Yield the metrics of all keys whose lines begin between two offsets, each with its end."""
    kind, wanted = b'{"kind":"metrics",', [f"{_encode(key)}:".encode() for key in keys]
    file.seek(max(start - 1, 0))
    position = start if start == 0 else start - 1 + len(file.readline(SMALL))  # a line's beginning
    while position < stop:
        line = _line(file, position, stop)
        position += len(line)
        if line.startswith(kind) and all(key in line for key in wanted):
            record = record_of(line, f"{file.name}, byte {position}")
            if isinstance(record, Metrics) and record.values.keys() >= set(keys):
                yield position, record


def _line(file: BinaryIO, start: int, end: int) -> bytes:
    """Read the line that begins at `start`. Raises: ValueError if it has no end."""
    line = file.readline(SMALL)
    if line.endswith(b"\n"):
        return line
    if len(line) == SMALL:
        raise ValueError(f"{file.name} has a line of more than {SMALL:,} bytes at byte {start}")
    raise ValueError(f"{file.name} ends at byte {start + len(line)}, before its commit at {end}")


def _numbers(values: Mapping[str, float]) -> dict[str, float]:
    return {key: float(value) for key, value in values.items()}


def _new_commit() -> Commit:
    return Commit(uuid4().hex, _now(), _now(), 0, "SCHEDULED")


def _write_commit(folder: Path, commit: Commit) -> None:
    write_file(folder / "commit.json", commit_bytes(commit))


def _now() -> int:
    return time.time_ns() // 1_000_000  # ms


_encode = json.JSONEncoder(separators=(",", ":")).encode
