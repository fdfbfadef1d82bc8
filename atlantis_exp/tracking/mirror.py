"""Send a run folder's journal to MLflow.

Sending again changes nothing: the store drops a known point (same key, step, time and value), files replace themselves
by name, and runs and models are looked up before they are created.
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

from atlantis_exp.runs.files import ARTIFACT, SMALL, is_whole, read_file, schema_of, write_file
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
"""A run folder's file with its cursor in the store of its own sessions."""
_PARENTS = ("sweeps", "searches")  # folders of parents, which have none themselves
_PARENT = rf"\.\./\.\./({'|'.join(_PARENTS)})/[A-Za-z0-9][A-Za-z0-9_.,~+=@-]{{0,199}}"

_POINTS = 5_000  # a batch: smaller ones cost more a point
_PIXELS = 4_096  # a side, of a picture: a file of some kilobytes can unpack to gigabytes
_PARAM_LENGTH = 6_000  # characters that MLflow keeps


@dataclass(frozen=True)
class Cursor:
    """A folder's store, run and published offset."""

    store: str
    identity: str
    run_id: str = ""
    offset: int = 0
    commit: str = ""  # the `digest` of the last fully published commit

    @classmethod
    def read(cls, note: Path) -> "Cursor | None":
        """Read a cursor; return None if it is missing or damaged, since sending all again is harmless."""
        try:
            return schema_of(cls).validate_json(read_file(note, SMALL), strict=True)
        except (FileNotFoundError, ValueError):
            return None

    def save(self, note: Path) -> None:
        write_file(note, json.dumps(asdict(self)).encode())


def publish(folder: Path, store: Store, is_primary: bool = True, listed: Collection[str] | None = None) -> bool:
    """Bring the MLflow run of a folder up to the folder's last commit; return whether it was behind.

    Safe to repeat, to interrupt, and to call from several processes at once. Without the folder's cursor it sends
    everything again, in order. It skips a run that has not started and, with a warning, a missing file. It leaves out
    infinite values (MLflow would show 1.8e308) and keeps NaN. A changed param becomes a tag: MLflow's params are final.

    Args:
        is_primary: makes this the store of `unfinished`; False leaves that to another one, if any.
        listed: the ids of the store's runs, if known; a folder whose run is not among them is sent again.

    Raises:
        ValueError: the journal is damaged, or the folder is a link.
        MlflowException, OSError, sqlite3.Error: MLflow cannot be reached; a later call sends the rest.
    """
    if folder.is_symlink():
        raise ValueError(f"{folder} is a link; replace it by a copy of its target")
    folder = folder.resolve()
    note = _note(folder, store, is_primary)
    with alone(note.with_suffix(".lock")):
        while (commit := read_commit(folder)) is not None and commit.status != "SCHEDULED":
            cursor = Cursor.read(note)
            is_lost = cursor is not None and listed is not None and cursor.run_id not in listed
            if cursor and (cursor.store, cursor.commit) == (store.address, digest(commit)) and not is_lost:
                return False
            try:
                _publish(folder, store, commit, note, cursor, is_primary)
                return True
            except ValueError:
                if read_commit(folder) == commit:
                    raise  # else its writer started over meanwhile
    return False


def _publish(folder: Path, store: Store, commit: Commit, note: Path, cursor: Cursor | None, is_primary: bool) -> None:
    cursor, run = _opened(cursor, note, folder, store, commit)
    mirror = _Mirror(folder, store, run)
    for offset, record in read(folder, cursor.offset, commit.offset):
        mirror.send(record)
        if len(mirror.points) >= _POINTS:
            mirror.flush()
            cursor = replace(cursor, offset=offset)
            cursor.save(note)
    if mirror.gone:
        _log.warning("%s: %d files are missing and not published, such as %s", folder, len(mirror.gone), mirror.gone[0])
    mirror.send_state(commit, _parent_run(folder, store, commit, is_primary))
    replace(cursor, offset=commit.offset, commit=digest(commit)).save(note)


def digest(commit: Commit) -> str:
    return sha256(commit_bytes(commit)).hexdigest()


def _note(folder: Path, store: Store, is_primary: bool) -> Path:
    """Return the file with a folder's cursor in a store."""
    primary = Cursor.read(folder / PRIMARY)
    if is_primary or primary is None or primary.store == store.address:
        return folder / PRIMARY
    return folder / f"published-{sha256(store.address.encode()).hexdigest()[:8]}.json"


def _opened(cursor: Cursor | None, note: Path, folder: Path, store: Store, commit: Commit) -> "tuple[Cursor, Run]":
    """Return a folder's cursor in a store and its run; if needed, create the run, and a cursor at its start."""
    run = store.run(cursor.run_id) if cursor and cursor.store == store.address and cursor.run_id else None
    if cursor and run:
        if cursor.identity == commit.identity == run.data.tags.get(IDENTITY):
            return cursor, run
        # A run of another folder is not ours: its cursor was copied or forged.
        is_own = (run.data.tags.get(IDENTITY), run.data.tags.get(FOLDER)) == (cursor.identity, str(folder))
        if is_own and cursor.identity != commit.identity:
            store.delete_run(cursor.run_id)  # it shows lines that the journal no longer has
    cursor = Cursor(store.address, commit.identity)
    cursor.save(note)  # for `unfinished`, if MLflow is unreachable
    run = store.open_run(folder, commit)
    cursor = replace(cursor, run_id=run.info.run_id)
    cursor.save(note)
    return cursor, run


def _parent_run(folder: Path, store: Store, commit: Commit, is_primary: bool) -> str | None:
    """Publish a folder's parent if needed, and return its run."""
    parent = Path(os.path.normpath(folder / commit.parent))
    is_named = folder.parent.name not in _PARENTS and re.fullmatch(_PARENT, commit.parent)
    if not is_named or parent.is_symlink() or parent.resolve().parent.name not in _PARENTS or not parent.exists():
        return None
    publish(parent, store, is_primary)
    cursor = Cursor.read(_note(parent, store, is_primary))
    return cursor.run_id if cursor else None


class _Mirror:
    """Send records of one folder to one run; every method may be repeated. Points and tags wait for `flush`."""

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
        """Return the content of a record's file, or None if it is missing or has another checksum."""
        file = self._folder / "artifacts" / record.path
        if not file.is_file():
            self.gone.append(record.path)
            return None
        content = read_file(file, ARTIFACT)
        if isinstance(record, Image) or is_whole(content, record.sha256):
            return content
        if isinstance(record, Model):  # any other file has a newer record of its own
            _log.warning("%s has changed since it was recorded and is not published", file)
        return None

    def _send_params(self, values: dict[str, str]) -> None:
        from mlflow.entities import Param

        values = {key: value[:_PARAM_LENGTH] for key, value in values.items()}
        params = [Param(key, value) for key, value in values.items() if key not in self._final]
        self._client.log_batch(self._run_id, params=params, synchronous=True)
        self._final = values | self._final
        self._tags |= {key: value for key, value in values.items() if self._final[key] != value}

    def _send_image(self, record: Image, content: bytes) -> None:
        # Named as MLflow's pages expect; `log_image` would give an image sent again another name.
        unique = uuid5(UUID(self._run_id), record.path)
        name = f"images/{record.key.replace('/', '~')}+step+{record.step}+timestamp+{record.time}+{unique}"
        try:
            small = _shrunk(content)
        except Exception as error:  # PIL raises all kinds
            raise ValueError(f"{self._folder / 'artifacts' / record.path} is not a PNG of a run: {error}") from None
        self._store.put(self._run_id, f"{name}.png", content)
        self._store.put(self._run_id, f"{name}+compressed.webp", small)
        self._tags["mlflow.loggedImages"] = "True"

    def _send_model(self, record: Model, content: bytes) -> None:
        from mlflow.entities import LoggedModelOutput, Metric

        experiment = self._store.experiment_id
        same = f"source_run_id = '{self._run_id}' AND tags.step = '{record.step}'"
        found = self._client.search_logged_models([experiment], same, max_results=1)
        name = re.sub("[/:.%\"']", "-", f"{self._run.info.run_name} {record.step}")  # MLflow refuses these
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
    """Convert a PNG to a WebP of the size of MLflow's previews."""
    from mlflow.tracking.multimedia import compress_image_size
    from PIL.PngImagePlugin import PngImageFile

    small = io.BytesIO()
    with PngImageFile(io.BytesIO(content)) as image:  # reads the head
        if max(image.size) > _PIXELS:
            raise ValueError(f"{image.width:,} x {image.height:,} pixels, more than {_PIXELS:,} a side")
        compress_image_size(image).save(small, "WEBP")
    return small.getvalue()
