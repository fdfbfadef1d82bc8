"""A run folder's journal as calls of MLflow.

Sending is at least once and repeatable, hence visible exactly once: the store drops a point that it has already (same
key, step, time and value), files replace themselves by name, runs and models are looked up before they are made.
"""

import io
import json
import logging
import math
import os
import re
from collections.abc import Collection
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import UUID, uuid5

from pydantic import TypeAdapter

from atlantis_exp.runs.files import ARTIFACT, SMALL, is_whole, read_file, write_file
from atlantis_exp.runs.folder import TRACEBACK
from atlantis_exp.runs.journal import (
    Artifact,
    Commit,
    Image,
    Metrics,
    Model,
    Params,
    Record,
    Tags,
    commit_bytes,
    read,
    read_commit,
)
from atlantis_exp.runs.lock import alone
from atlantis_exp.tracking.local import Point
from atlantis_exp.tracking.store import FOLDER, IDENTITY, Store, labels_of

if TYPE_CHECKING:
    from mlflow.entities import Run

_log = logging.getLogger(__name__)

PRIMARY = "published.json"
"""The file of a run folder that notes how far its own sessions have published it."""
PLACE = r"([a-z]+)/[A-Za-z0-9][A-Za-z0-9_.,~+=@-]{0,199}"
"""A run folder's place in an outputs folder."""
_PARENT = rf"\.\./\.\./{PLACE}"  # as a run folder names the one that it is shown under

_POINTS = 5_000  # to be sent together: fewer cost more each
_PIXELS = 4_096  # a side, of a picture: a file of some kilobytes can unpack to gigabytes
_PARAM_LENGTH = 6_000  # characters that MLflow keeps


@dataclass(frozen=True)
class Cursor:
    """How far a folder is published, where to, and as which run."""

    store: str
    identity: str
    run_id: str = ""
    offset: int = 0
    commit: str = ""  # the `digest` of the last commit that is published in full

    @classmethod
    def read(cls, note: Path) -> "Cursor | None":
        """Return what was noted; None also if that is damaged, since sending all again is harmless."""
        try:
            return _CURSOR.validate_json(read_file(note, SMALL), strict=True)
        except (FileNotFoundError, ValueError):
            return None

    def save(self, note: Path) -> None:
        """Note it in a file."""
        write_file(note, json.dumps(asdict(self)).encode())


_CURSOR = TypeAdapter(Cursor)


def publish(folder: Path, store: Store, is_primary: bool = True) -> bool:
    """Bring the MLflow run of a folder up to the folder's last commit; return whether it was behind.

    A run that has yet to start is left alone. May be repeated, interrupted, and run by several processes at once
    without doubling anything. How far it came is noted in `published.json`; without that file everything is sent again.
    Lines are sent in their order, so a step never runs backwards. Infinite values are left out (MLflow would show
    1.8e308; the journal has them), NaN is kept. A file that is gone is passed over with a warning. A param that changes
    once MLflow has it, as final there, becomes a tag.

    Args:
        is_primary: whether this becomes the store that `unfinished` asks for; False leaves that to the one that is, if
            any, and notes in a file of its own how far it came.

    Raises:
        ValueError: on a damaged journal, or a folder that is a link.
        MlflowException, OSError, sqlite3.Error: if MLflow cannot be reached; what is missing stays to be published.
    """
    if folder.is_symlink():
        raise ValueError(f"{folder} is a link, behind which nothing is written")
    folder = folder.resolve()
    note = _note(folder, store, is_primary)
    with alone(note.with_suffix(".lock")):
        while (commit := read_commit(folder)) is not None and commit.status != "SCHEDULED":
            try:
                return _publish(folder, store, commit, note, is_primary)
            except ValueError:
                if read_commit(folder) == commit:
                    raise  # else its writer began anew while it was read
    return False


def _publish(folder: Path, store: Store, commit: Commit, note: Path, is_primary: bool) -> bool:
    cursor = Cursor.read(note)
    if cursor and (cursor.store, cursor.commit) == (store.address, digest(commit)):
        return False
    cursor, run = _opened(cursor, note, folder, store, commit)
    mirror = _Mirror(folder, store, run)
    for offset, record in read(folder, cursor.offset, commit.offset):
        mirror.send(record)
        if len(mirror.points) >= _POINTS:
            mirror.flush()
            cursor = replace(cursor, offset=offset)
            cursor.save(note)
    if mirror.gone:
        _log.warning("%s: %d files are gone and not published, such as %s", folder, len(mirror.gone), mirror.gone[0])
    mirror.send_state(commit, _parent_run(folder, store, commit, is_primary))
    replace(cursor, offset=commit.offset, commit=digest(commit)).save(note)
    return True


def digest(commit: Commit) -> str:
    """Return a hash of a commit, to be compared."""
    return sha256(commit_bytes(commit)).hexdigest()


def noted(folder: Path) -> list[Cursor]:
    """Return how far a folder is published in each store."""
    return [cursor for note in folder.glob("published*.json") if (cursor := Cursor.read(note))]


def forget_lost(folder: Path, store: Store, listed: Collection[str]) -> None:
    """Let a folder be published anew if its run is not among those that the store lists."""
    note = _note(folder, store, is_primary=False)
    cursor = Cursor.read(note)
    if cursor is not None and cursor.store == store.address and cursor.run_id not in listed:
        Cursor(cursor.store, cursor.identity).save(note)


def _note(folder: Path, store: Store, is_primary: bool) -> Path:
    """The file that says how far a folder is published in a store."""
    primary = Cursor.read(folder / PRIMARY)
    if is_primary or primary is None or primary.store == store.address:
        return folder / PRIMARY
    return folder / f"published-{sha256(store.address.encode()).hexdigest()[:8]}.json"


def _opened(cursor: Cursor | None, note: Path, folder: Path, store: Store, commit: Commit) -> "tuple[Cursor, Run]":
    """Return the cursor of a folder in a store and its run, at the start of a found or new run if there was none."""
    run = store.run(cursor.run_id) if cursor and cursor.store == store.address and cursor.run_id else None
    if cursor and run:
        if cursor.identity == commit.identity == run.data.tags.get(IDENTITY):
            return cursor, run
        # Of another folder it would be somebody else's, named by a note that was copied or made up.
        is_own = (run.data.tags.get(IDENTITY), run.data.tags.get(FOLDER)) == (cursor.identity, str(folder))
        if is_own and cursor.identity != commit.identity:
            store.delete_run(cursor.run_id)  # it shows lines that the journal has taken back
    cursor = Cursor(store.address, commit.identity)
    cursor.save(note)  # should MLflow be out of reach, `unfinished` tells others where it is to go
    run = store.open_run(folder, commit)
    cursor = replace(cursor, run_id=run.info.run_id)
    cursor.save(note)
    return cursor, run


def _parent_run(folder: Path, store: Store, commit: Commit, is_primary: bool) -> str | None:
    """The run that a folder's is shown under, which is published if it is not yet there."""
    _check_parents(folder, commit.parent)
    parent = Path(os.path.normpath(folder / commit.parent))
    if not re.fullmatch(_PARENT, commit.parent) or parent.is_symlink() or not parent.exists():
        return None
    publish(parent, store, is_primary)
    cursor = Cursor.read(_note(parent, store, is_primary))
    return cursor.run_id if cursor else None


def _check_parents(folder: Path, parent: str) -> None:
    """Refuse a parent that is shown under the folder itself, or under itself. Raises: ValueError."""
    places = [Path(os.path.normpath(folder))]
    while re.fullmatch(_PARENT, parent):
        place = Path(os.path.normpath(places[-1] / parent))
        if place in places:
            raise ValueError(f"{place} is its own parent")
        places.append(place)
        commit = None if place.is_symlink() else read_commit(place)
        parent = commit.parent if commit else ""


class _Mirror:
    """Sends records of one folder to one run; every method may be repeated.

    Points and tags, which are many, wait for `flush`.
    """

    def __init__(self, folder: Path, store: Store, run: "Run") -> None:
        self._folder = folder
        self._store = store
        self._client = store.client
        self._run = run
        self._run_id = run.info.run_id
        self.points: list[Point] = []
        self.gone: list[str] = []
        self._tags: dict[str, str] = {}
        self._known = {**run.data.tags}
        self._final = {**run.data.params}

    def flush(self) -> None:
        from mlflow.entities import RunTag

        self._store.log_points(self._run_id, self.points)
        new = {key: value for key, value in self._tags.items() if self._known.get(key) != value}
        tags = [RunTag(key, value) for key, value in new.items()]
        self._client.log_batch(self._run_id, tags=tags, synchronous=True)
        self._known |= new
        self.points.clear()
        self._tags.clear()

    def send_state(self, commit: Commit, parent_run: str | None) -> None:
        if commit.status == "RUNNING":
            self._client.update_run(self._run_id, commit.status)
        else:
            self._client.set_terminated(self._run_id, commit.status, commit.updated)
        self._tags |= {**labels_of(commit), "resumable": str(commit.status in ("KILLED", "FAILED")).lower()}
        if parent_run:
            self._tags["mlflow.parentRunId"] = parent_run
        if commit.error:
            self._tags["error"] = commit.error
            if (self._folder / TRACEBACK).exists():
                self._store.put(self._run_id, TRACEBACK, read_file(self._folder / TRACEBACK, SMALL))
        elif "error" in self._known:
            self._client.delete_tag(self._run_id, "error")
        self.flush()

    def send(self, record: Record) -> None:
        if isinstance(record, Metrics):
            self.points += _points(record)
        elif isinstance(record, Tags):
            self._tags |= record.values
        elif isinstance(record, Params):
            self._send_params(record.values)
        elif (content := self._content(record)) is not None:
            match record:
                case Artifact(path):
                    self._store.put(self._run_id, path, content)
                case Image():
                    self._send_image(record, content)
                case Model():
                    self._send_model(record, content)

    def _content(self, record: Artifact | Image | Model) -> bytes | None:
        """The file that a record names, None if it is gone or another."""
        file = self._folder / "artifacts" / record.path
        if not file.is_file():
            self.gone.append(record.path)
            return None
        content = read_file(file, ARTIFACT)
        if isinstance(record, Image) or is_whole(content, record.sha256):
            return content
        if isinstance(record, Model):  # else it is newer than this record, and has, or will have, one of its own
            _log.warning("%s is not what was recorded and is not published", file)
        return None

    def _send_params(self, values: dict[str, str]) -> None:
        from mlflow.entities import Param

        values = {key: value[:_PARAM_LENGTH] for key, value in values.items()}
        params = [Param(key, value) for key, value in values.items() if key not in self._final]
        self._client.log_batch(self._run_id, params=params, synchronous=True)
        self._final = values | self._final
        self._tags |= {key: value for key, value in values.items() if self._final[key] != value}

    def _send_image(self, record: Image, content: bytes) -> None:
        # `log_image` with a key would name the files at random, so that an image sent again would be a second one.
        name = _image_name(self._run_id, record)
        try:
            small = _shrunk(content)
        except Exception as error:  # PIL raises anything
            raise ValueError(f"{self._folder / 'artifacts' / record.path} is no PNG of a run: {error}") from None
        self._store.put(self._run_id, f"{name}.png", content)
        self._store.put(self._run_id, f"{name}+compressed.webp", small)
        self._tags["mlflow.loggedImages"] = "True"

    def _send_model(self, record: Model, content: bytes) -> None:
        from mlflow.entities import LoggedModelOutput, Metric

        experiment = self._store.experiment_id
        same = f"source_run_id = '{self._run_id}' AND tags.step = '{record.step}'"
        found = self._client.search_logged_models([experiment], same, max_results=1)
        name = re.sub("[/:.%\"']", "-", f"{self._run.info.run_name} {record.step}")  # MLflow takes these in no model's
        create = self._client.create_logged_model
        model = found[0] if found else create(experiment, name, self._run_id, {"step": str(record.step)})
        model_id = model.model_id
        self._store.put(self._run_id, os.path.basename(record.path), content, model_id)
        self._client.finalize_logged_model(model_id, "READY")
        outputs = self._client.get_run(self._run_id).outputs
        if not outputs or model_id not in {output.model_id for output in outputs.model_outputs}:
            self._client.log_outputs(self._run_id, [LoggedModelOutput(model_id, record.step)])
        metrics = [Metric(*point, model_id=model_id) for point in _points(record)]
        self._client.log_batch(self._run_id, metrics=metrics, synchronous=True)
        if record.best:
            same = f"source_run_id = '{self._run_id}' AND tags.best = 'true'"
            for other in self._client.search_logged_models([experiment], same):
                if other.model_id != model_id:
                    self._client.delete_logged_model_tag(other.model_id, "best")
            self._client.set_logged_model_tags(model_id, {"best": "true"})


def _points(record: Metrics | Model) -> list[Point]:
    return [(key, value, record.time, record.step) for key, value in record.values.items() if not math.isinf(value)]


def _shrunk(content: bytes) -> bytes:
    """A PNG, the only format that is tried, as small as MLflow's pages show it at first, as WebP."""
    from mlflow.tracking.multimedia import compress_image_size
    from PIL.PngImagePlugin import PngImageFile

    small = io.BytesIO()
    with PngImageFile(io.BytesIO(content)) as image:  # reads the head
        if max(image.size) > _PIXELS:
            raise ValueError(f"{image.width:,} x {image.height:,} pixels, more than {_PIXELS:,} a side")
        compress_image_size(image).save(small, "WEBP")
    return small.getvalue()


def _image_name(run_id: str, record: Image) -> str:
    """The path of an image among its run's artifacts, without its ending, as MLflow's pages look for it."""
    unique = uuid5(UUID(run_id), record.path)
    return f"images/{record.key.replace('/', '~')}+step+{record.step}+timestamp+{record.time}+{unique}"
