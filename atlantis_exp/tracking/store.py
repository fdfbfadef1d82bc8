"""MLflow: a mirror of run folders, which can be thrown away and made again from them.

Sending is at least once and repeatable, hence visible exactly once: MLflow drops a point that it has already (same key,
step, time and value), files overwrite themselves by name, runs and models are looked up before they are made.
"""

import gzip
import io
import json
import logging
import math
import os
import re
import shutil
import signal
import sqlite3
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, cast
from urllib.parse import urlsplit
from uuid import UUID, uuid5

from pydantic import AliasChoices, Field, TypeAdapter

from atlantis_exp import terminal
from atlantis_exp.runs.files import ARTIFACT, SMALL, is_whole, open_file, read_file, write_file
from atlantis_exp.runs.folder import COMMIT, CONFIG, LOOKS, RESULT, TRACEBACK
from atlantis_exp.runs.journal import (
    Artifact,
    Commit,
    Image,
    Metrics,
    Model,
    Params,
    Tags,
    commit_bytes,
    read,
    read_commit,
)
from atlantis_exp.runs.lock import alone
from atlantis_exp.tracking.views import experiment_tags

if TYPE_CHECKING:
    import PIL.Image
    from mlflow import MlflowClient
    from mlflow.entities import LoggedModel, Metric, Run
    from mlflow.store.artifact.mlflow_artifacts_repo import MlflowArtifactsRepository
    from mlflow.store.entities import PagedList

P = TypeVar("P")

_log = logging.getLogger(__name__)

PLACE = r"([a-z]+)/[A-Za-z0-9][A-Za-z0-9_.,~+=@-]{0,199}"
"""What a run's folder is called under an outputs folder."""
PARENT = rf"\.\./\.\./{PLACE}"
"""How a run's folder names the one that it is shown under."""

DATABASE = "mlflow.db"
"""The local store, in an outputs folder."""

_SECONDS = 60  # that a server may take for an answer, or for so many bytes of a file:
_PIECE = 2**16
_PAGES = 1_000  # of 1,000 runs each, that a server may list

_POINTS = 500  # a call at least, where there are so many: fewer cost more each
_PIXELS = 4_096  # a side, of a picture: a file of some kilobytes can unpack to gigabytes
_PARAM_LENGTH = 6_000  # characters that MLflow keeps
_IDENTITY, _FOLDER = "atlantis.identity", "atlantis.folder"  # tags: which run this is, and where it was published from
_RUN_NAME = "mlflow.runName"
_NAME_LENGTH = 250  # characters of a run's name that a PostgreSQL store takes
_PRIMARY = "published.json"

ORIGIN = "origin.json"
"""Where a folder that was brought from a server notes how far it is one with the run there."""
SMALL_FILES = (CONFIG, RESULT, TRACEBACK, LOOKS)
"""The small files that a run folder may hold besides its `commit.json`."""
FILES_TAG = "atlantis.standing"
"""The tag of a run whose folder is on the server as of a commit: `files_digest` of its small files."""
TRAVELS = "run_folder"
"""Where a run's artifacts hold its folder's small files and, in `journal/`, the committed bytes of its journal."""
CHUNK = 2**23  # bytes of a journal that travel in one file


@dataclass(frozen=True)
class StoredRun:
    """A run as MLflow lists it; `folder` is where it was published from."""

    run_id: str
    name: str
    status: str
    folder: Path
    params: dict[str, str]
    tags: dict[str, str]


class Store:
    """One experiment of an MLflow database under `root`, a folder on a local disk, or of the server at `tracking_uri`.

    A server is also sent the folders' own small files, of which they can be made again elsewhere (see `travel`).

    Constructing one does nothing: MLflow is imported (1-3 s) and its tables are made on first use, which any number of
    processes may come to at once.
    """

    def __init__(self, root: Path, experiment: str = "atlantis", tracking_uri: str | None = None) -> None:
        self._root = root.resolve()
        self._experiment = experiment
        self.is_local = tracking_uri is None
        self.uri = tracking_uri or f"sqlite:///{self._root / DATABASE}"

    @property
    def client(self) -> "MlflowClient":
        """MLflow's own client, for what is not mirrored from a folder."""
        return self._connection[0]

    @property
    def experiment_id(self) -> str:
        """The id of the experiment, which is made if need be."""
        return self._connection[1]

    def runs(self, name: str | None = None) -> list[StoredRun]:
        """Returns the runs that were published here, the latest first; given a name, only those that bear it."""
        published = "tags.`atlantis.folder` != ''"
        wanted = published if name is None else f'{published} AND attributes.run_name = "{name}"'
        found: list[StoredRun] = []
        search = partial(self.client.search_runs, [self.experiment_id], wanted)
        for page in _pages(search):
            found += [
                StoredRun(
                    run.info.run_id,
                    run.info.run_name,
                    run.info.status,
                    Path(run.data.tags[_FOLDER]),
                    run.data.params,
                    run.data.tags,
                )
                for run in page
            ]
        return found

    def models(self, run_id: str) -> "list[LoggedModel]":
        """Returns the models of a run."""
        same = f"source_run_id = '{run_id}'"
        search = partial(self.client.search_logged_models, [self.experiment_id], same)
        return [model for page in _pages(search) for model in page]

    def files(self, location: str) -> "Files":
        """Returns the files of a run or model, whose location the server names.

        Raises:
            ValueError: where they are not behind the server: it may name no place on this machine, and no other server,
                which would be sent this one's user and password.
        """
        from mlflow.store.artifact.mlflow_artifacts_repo import MlflowArtifactsRepository

        place = urlsplit(location)
        if place.scheme != "mlflow-artifacts":
            raise ValueError(f"its files are in {location}; only a server with --serve-artifacts gives them out")
        if place.netloc not in ("", urlsplit(self.uri).netloc):
            raise ValueError(f"its files are said to be on {place.netloc}, another server, which is not asked")
        return Files(MlflowArtifactsRepository(location, self.uri))

    def prepare(self) -> None:
        """Makes the experiment explain itself and seeds its shared views, see `views`."""
        newest = next((run for run in self.runs() if run.tags.get("atlantis.kind") == "comparison"), None)
        place = f"#/experiments/{self.experiment_id}/runs"
        linked = f"[{newest.name}]({place}/{newest.run_id})" if newest else None
        for key, value in experiment_tags(linked).items():
            self.client.set_experiment_tag(self.experiment_id, key, value)

    @property
    def address(self) -> str:
        """What tells this experiment from any other, in this database or elsewhere."""
        return f"{self.uri}#{self._experiment}"

    def open_run(self, folder: Path, commit: Commit) -> str:
        """Returns the id of the run that mirrors a folder; makes the run if it is not there."""
        same = f"tags.`{_IDENTITY}` = '{commit.identity}'"
        if found := self.client.search_runs([self.experiment_id], same, max_results=1):
            return str(found[0].info.run_id)
        labels = _labels(commit)
        tags = {_IDENTITY: commit.identity, _FOLDER: str(folder), **labels}
        name = labels.get(_RUN_NAME, folder.name)
        return str(self.client.create_run(self.experiment_id, commit.started, tags, name).info.run_id)

    def run(self, run_id: str) -> "Run | None":
        """Returns a run, None where it is not there or was deleted."""
        from mlflow.exceptions import MlflowException

        try:
            run = self.client.get_run(run_id)
        except MlflowException as error:
            if error.error_code != "RESOURCE_DOES_NOT_EXIST":
                raise
            return None
        return run if run.info.lifecycle_stage == "active" else None

    def fault(self, error: Exception) -> Exception | None:
        """Returns why the store takes nothing, None where it answers: what raised the error is one folder's fault."""
        if isinstance(error, ValueError):  # which is what a folder's own files raise
            return None
        if isinstance(error, TooSlow) or getattr(error, "error_code", "") == "TEMPORARILY_UNAVAILABLE":
            return error
        try:
            self.client.get_experiment(self.experiment_id)
        except Exception as fault:
            return fault
        return None

    def delete_run(self, run_id: str) -> None:
        """Deletes a run and its models, which MLflow would keep."""
        for model in self.models(run_id):
            self.client.delete_logged_model(model.model_id)
        self.client.delete_run(run_id)

    @cached_property
    def _connection(self) -> tuple["MlflowClient", str]:
        os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")  # the default holds a call for 246 s
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "10")  # seconds
        os.environ.setdefault("MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT", "true")
        os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
        for way in ("UPLOAD", "DOWNLOAD"):  # files would go to, or come from, whatever address the server names
            os.environ.setdefault(f"MLFLOW_ENABLE_PROXY_MULTIPART_{way}", "false")
        from mlflow import MlflowClient

        # Whatever fails in MLflow reaches us as an exception; its log would add a traceback to each.
        logging.getLogger("mlflow").setLevel(logging.CRITICAL)
        logging.getLogger("alembic").setLevel(logging.WARNING)
        with alone(self._root / "mlflow.lock"):  # processes that make the tables together break them for good
            if self.is_local:
                database_file = self._root / DATABASE
                if not database_file.exists():
                    # MLflow never recovers from a process that dies while it makes the tables: they are made aside.
                    aside = self._root / "mlflow.aside"
                    shutil.rmtree(aside, ignore_errors=True)
                    aside.mkdir()
                    MlflowClient(f"sqlite:///{aside / DATABASE}").get_experiment_by_name(self._experiment)
                    (aside / DATABASE).replace(database_file)
                    shutil.rmtree(aside)
                with closing(sqlite3.connect(database_file)) as database:
                    database.execute("PRAGMA journal_mode=WAL")  # else one slow reader makes a write fail
            client = MlflowClient(self.uri)
            if not self.is_local:
                client = cast("MlflowClient", _Patient(client))
            if experiment := client.get_experiment_by_name(self._experiment):
                return client, experiment.experiment_id
            # MLflow's own choice would depend on the working directory of whoever comes first.
            location = (self._root / "artifacts" / self._experiment).as_uri() if self.is_local else None
            try:
                return client, client.create_experiment(self._experiment, location)
            except Exception:
                if experiment := client.get_experiment_by_name(self._experiment):
                    return client, experiment.experiment_id  # another machine was faster
                raise


class TooSlow(Exception):
    """A server that has not answered in full by the time it had; no OSError, which clients take for one to retry."""


@contextmanager
def patience(more: int = 0) -> Iterator[None]:
    """Raise TooSlow after `_SECONDS` and some more in the block: a server that drips bytes never times out.

    Only in the main thread, where a signal can end a wait.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    late: list[TooSlow] = []

    def give_up(*_: object) -> None:
        late.append(TooSlow(f"the server has not answered in full within {_SECONDS + more} seconds"))
        raise late[0]

    before = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(_SECONDS + more)
    try:
        yield
    except Exception:
        if late:  # which MLflow wraps
            raise late[0] from None
        raise
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


class _Patient:
    """A server's client whose calls each have their time; a file that is sent, a second more for each 64 KiB."""

    def __init__(self, client: "MlflowClient") -> None:
        self._client = client

    def __getattr__(self, name: str) -> Callable[..., Any]:
        call = getattr(self._client, name)

        def bounded(*arguments: Any, **options: Any) -> Any:
            sent = os.path.getsize(arguments[1]) if name in ("log_artifact", "log_model_artifact") else 0
            with patience(sent // _PIECE):
                return call(*arguments, **options)

        return bounded


def _pages(search: "Callable[..., PagedList[P]]") -> "Iterator[PagedList[P]]":
    """The pages of a search, as far as there may be."""
    token: str | None = None
    for _ in range(_PAGES):
        yield (page := search(page_token=token))
        if not (token := page.token):
            return
    raise ValueError(f"the server lists more than {_PAGES:,} pages")


class Files:
    """The files of a run or model on a server, by their paths."""

    def __init__(self, repository: "MlflowArtifactsRepository") -> None:
        self._repository = repository

    def names(self, folder: str) -> set[str]:
        """Returns the names of what lies in a folder, none where there is no such folder."""
        with patience():
            return {os.path.basename(file.path) for file in self._repository.list_artifacts(folder)}  # type: ignore[no-untyped-call]

    def read(self, path: str, most: int) -> bytes:
        """Returns what a file of at most so many bytes holds. Raises: ValueError, TooSlow."""
        from mlflow.utils.credentials import get_default_host_creds
        from mlflow.utils.rest_utils import http_request

        with patience():
            host = get_default_host_creds(self._repository.artifact_uri)  # type: ignore[no-untyped-call]
            response = http_request(host, f"/{path}", "GET", stream=True)  # type: ignore[no-untyped-call]
        with closing(response):
            response.raise_for_status()
            content, chunks = bytearray(), response.iter_content(_PIECE)
            while True:
                with patience():
                    chunk = next(chunks, b"")
                if not chunk:
                    return bytes(content)
                content += chunk
                if len(content) > most:
                    raise ValueError(f"{path} has more than {most:,} bytes on the server")


def unfinished(folder: Path, root: Path) -> Store | None:
    """Returns the store, with its files under `root`, that lacks a part of what a published folder has committed."""
    cursor, commit = Cursor.read(folder / _PRIMARY), read_commit(folder)
    if cursor is None or commit is None:
        return None
    is_server = cursor.store.startswith("http")
    if cursor.files == files_digest(small_files(folder, commit, is_server)):
        return None
    uri, _, experiment = cursor.store.rpartition("#")
    return Store(root, experiment, uri if is_server else None)


class Publisher:
    """A thread that keeps MLflow up to date with a run folder's commits, and with others', and never disturbs the runs.

    It looks at the folders every `interval` seconds; while MLflow fails, less and less often, down to once a minute.
    """

    def __init__(self, folder: Path, store: Store, interval: float = 5.0, others: Sequence[Path] = ()) -> None:
        self._folders = (folder, *others)
        self._store = store
        self._interval = interval
        self._draining = threading.Event()
        self._thread = threading.Thread(target=self._run, name="publisher", daemon=True)
        self._thread.start()

    def drain(self, timeout: float) -> bool:
        """Publishes what is committed by now and stops; False if that took more than `timeout` seconds.

        What is left then is published while the process lives, and by `publish` later.
        """
        self._draining.set()
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        delay, failing, told = self._interval, False, set[Path]()
        while True:
            draining = self._draining.is_set()  # asked first: what is committed before a drain is published by it
            fault: Exception | None = None  # of the store; a folder's own is no reason to skip the others, or to wait
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
                    _log.warning("Publishing to MLflow fails (%s); the run goes on and is published later", reason)
                delay, failing = min(2 * delay, 60.0), True
            else:
                if failing:
                    _log.warning("Publishing to MLflow works again and is up to date")
                delay, failing = self._interval, False
                if draining:
                    return
            if draining:
                time.sleep(1.0)
            else:
                self._draining.wait(delay)


def first_line(error: Exception) -> str:
    """Returns what went wrong, in a line."""
    return terminal.harmless(f"{type(error).__name__}: {error}".partition("\n")[0])


def publish(folder: Path, store: Store, is_primary: bool = True) -> bool:
    """Brings the MLflow run of a folder up to the folder's last commit; returns whether it was behind.

    A run that has yet to start is left alone.

    May be repeated, interrupted, and run by several processes at once without doubling anything. How far it came is
    noted in `published.json`; without that file everything is sent again. Lines are sent in their order, so a step
    never runs backwards. Infinite values are left out (MLflow would show 1.8e308; the journal has them), NaN is kept. A
    file that is gone is passed over with a warning. A param that changes once MLflow has it, as final there, becomes a
    tag.

    Args:
        is_primary: whether this becomes the store that `unfinished` asks for; False leaves that to the one that is, if
            any, and notes in a file of its own how far it came.

    Raises:
        ValueError: on a damaged journal, or a folder that is a link.
        MlflowException, OSError, sqlite3.Error: when MLflow cannot be reached; what is missing stays to be published.
    """
    if folder.is_symlink():
        raise ValueError(f"{folder} is a link, behind which nothing is written")
    folder = folder.resolve()
    note = _note(folder, store, is_primary)
    with alone(note.with_suffix(".lock")):
        commit = read_commit(folder)
        if commit is None or commit.status == "SCHEDULED":
            return False
        files = small_files(folder, commit, is_server=not store.is_local)
        cursor = Cursor.of(note, folder, store, commit)
        if cursor.files == files_digest(files):
            return False
        run = store.run(cursor.run_id)
        if run is None or run.data.tags.get(_IDENTITY) != commit.identity:  # deleted, and here it went on, or another's
            Cursor(store.address, commit.identity).save(note)
            cursor = Cursor.of(note, folder, store, commit)
            run = store.client.get_run(cursor.run_id)
        mirror = _Mirror(folder, store, run)
        if not store.is_local:
            mirror.send_journal(cursor.offset, commit.offset)
        points: list[Metric] = []
        for offset, record in read(folder, cursor.offset, commit.offset):
            if isinstance(record, Metrics):
                points += mirror.unsent(record)
                if len(points) < _POINTS and offset < commit.offset:
                    continue
            mirror.send_points(points)
            points.clear()
            if not isinstance(record, Metrics):
                mirror.send(record)
            cursor = replace(cursor, offset=offset)
            cursor.save(note)
        mirror.send_state(commit, _parent_run(folder, store, commit, is_primary))
        if not store.is_local:
            mirror.send_small_files(files)
        replace(cursor, files=files_digest(files)).save(note)
        return True


def forget_lost(folder: Path, store: Store, listed: Collection[str]) -> None:
    """Lets a folder be published anew whose run is no longer among those that the store has listed."""
    note = _note(folder, store, is_primary=False)
    cursor = Cursor.read(note)
    if cursor is not None and note.name != ORIGIN and cursor.store == store.address and cursor.run_id not in listed:
        Cursor(cursor.store, cursor.identity).save(note)


def _note(folder: Path, store: Store, is_primary: bool) -> Path:
    """The file that says how far a folder is published in a store."""
    if (origin := brought(folder)) is not None and origin.store == store.address:
        return folder / ORIGIN
    primary = Cursor.read(folder / _PRIMARY)
    if is_primary or primary is None or primary.store == store.address:
        return folder / _PRIMARY
    return folder / f"published-{sha256(store.address.encode()).hexdigest()[:8]}.json"


def _labels(commit: Commit) -> dict[str, str]:
    """What a run is shown by, its name no longer than a store takes."""
    return {key: text[:_NAME_LENGTH] if key == _RUN_NAME else text for key, text in commit.labels.items()}


def small_files(folder: Path, commit: Commit, is_server: bool = True) -> dict[str, bytes]:
    """Returns the content, by name, of the files that say what a run is and what state it is in.

    A local store can read the folder and needs none but the commit.
    """
    names = [name for name in SMALL_FILES if is_server and (folder / name).exists()]
    return {COMMIT: commit_bytes(commit), **{name: read_file(folder / name, SMALL) for name in names}}


def files_digest(files: Mapping[str, bytes]) -> str:
    """Returns a hash of small files, to be compared."""
    return sha256(json.dumps({name: sha256(files[name]).hexdigest() for name in sorted(files)}).encode()).hexdigest()


def brought(folder: Path) -> "Cursor | None":
    """Returns whence a folder was brought, if it still is the run that was; that one is another folder's to change."""
    origin, commit = Cursor.read(folder / ORIGIN), read_commit(folder)
    return origin if origin and commit and origin.identity == commit.identity else None


def check_parents(folder: Path, parent: str) -> None:
    """Refuse a parent that is shown under the folder itself, or under itself. Raises: ValueError."""
    places = [Path(os.path.normpath(folder))]
    while re.fullmatch(PARENT, parent):
        place = Path(os.path.normpath(places[-1] / parent))
        if place in places:
            raise ValueError(f"{place} is its own parent")
        places.append(place)
        commit = None if place.is_symlink() else read_commit(place)
        parent = commit.parent if commit else ""


def _parent_run(folder: Path, store: Store, commit: Commit, is_primary: bool) -> str | None:
    """The run that a folder's is shown under, which is published if it is not yet there."""
    check_parents(folder, commit.parent)
    parent = Path(os.path.normpath(folder / commit.parent))
    if not re.fullmatch(PARENT, commit.parent) or parent.is_symlink() or not parent.exists():
        return None
    publish(parent, store, is_primary)
    cursor = Cursor.read(_note(parent, store, is_primary))
    return cursor.run_id if cursor else None


@dataclass(frozen=True)
class Cursor:
    """How far a folder is published, where to, and as which run."""

    store: str
    identity: str
    run_id: str = ""
    offset: int = 0
    files: Annotated[str, Field(validation_alias=AliasChoices("files", "standing"))] = ""  # `files_digest`, once sent

    @classmethod
    def of(cls, note: Path, folder: Path, store: Store, commit: Commit) -> "Cursor":
        """Returns the folder's cursor in this store, at the start of a found or new run if there is none."""
        cursor = cls.read(note)
        if cursor is None or (cursor.store, cursor.identity) != (store.address, commit.identity):
            if cursor is not None and cursor.store == store.address and cursor.run_id:
                run = store.run(cursor.run_id)
                # Of another folder it would be somebody else's, named by a note that was copied or made up.
                if run and (run.data.tags.get(_IDENTITY), run.data.tags.get(_FOLDER)) == (cursor.identity, str(folder)):
                    store.delete_run(cursor.run_id)  # it shows lines that the journal has taken back
            cursor = cls(store.address, commit.identity)
            cursor.save(note)  # should MLflow be out of reach, `unfinished` tells others where it is to go
        if not cursor.run_id:
            cursor = replace(cursor, run_id=store.open_run(folder, commit))
            cursor.save(note)
        return cursor

    @classmethod
    def read(cls, note: Path) -> "Cursor | None":
        """Returns what was noted; None also where that is damaged, since sending all again is harmless."""
        try:
            return _CURSOR.validate_json(read_file(note, SMALL), strict=True)
        except (FileNotFoundError, ValueError):
            return None

    def save(self, note: Path) -> None:
        write_file(note, json.dumps(asdict(self)).encode())


_CURSOR = TypeAdapter(Cursor)


class _Mirror:
    """Sends records of one folder to one run; every method may be repeated."""

    def __init__(self, folder: Path, store: Store, run: "Run") -> None:
        self._journal = folder / "journal.jsonl"
        self._artifacts = folder / "artifacts"
        self._traceback = folder / TRACEBACK
        self._client = store.client
        self._experiment_id = store.experiment_id
        self._run_id = run.info.run_id
        self._name = run.info.run_name
        self._latest = {point.key: point.timestamp for point in run.data._metric_objs}

    def unsent(self, record: Metrics) -> "list[Metric]":
        """Returns a record's points but for those that MLflow is sure to have.

        Points go out in the order of their time, so MLflow has all that precede the latest one of their key. Sending
        those again would be harmless but slow: MLflow looks each up, in 10 ms among 240,000 points.
        """
        return [point for point in self._points(record) if point.timestamp >= self._latest.get(point.key, 0)]

    def _points(self, record: Metrics | Model, model_id: str | None = None) -> "list[Metric]":
        from mlflow.entities import Metric

        return [
            Metric(key, value, record.time, record.step, model_id=model_id, run_id=self._run_id)
            for key, value in record.values.items()
            if not math.isinf(value)
        ]

    def send_points(self, points: "list[Metric]") -> None:
        self._client.log_batch(self._run_id, metrics=points, synchronous=True)

    def send_journal(self, start: int, end: int) -> None:
        """Sends committed bytes as they are; a file is named by where it begins, and may be sent again with more."""
        if start == end:
            return
        with open_file(self._journal) as file:
            file.seek(start)
            while start < end:
                content = file.read(min(CHUNK, end - start))
                if not content:
                    raise ValueError(f"{file.name} ends at byte {start}, before its commit at {end}")
                self._send_file(f"{TRAVELS}/journal/{start:012d}.gz", gzip.compress(content, mtime=0))
                start += len(content)

    def send_small_files(self, files: Mapping[str, bytes]) -> None:
        for name, content in files.items():
            self._send_file(f"{TRAVELS}/{name}", content)
        self._send_tags({FILES_TAG: files_digest(files)})  # last: who finds it finds all of them

    def _send_file(self, path: str, content: bytes) -> None:
        with TemporaryDirectory() as aside:
            file = Path(aside, os.path.basename(path))
            file.write_bytes(content)
            self._client.log_artifact(self._run_id, str(file), os.path.dirname(path))

    def send_state(self, commit: Commit, parent_run: str | None) -> None:
        if commit.status == "RUNNING":
            self._client.update_run(self._run_id, commit.status)
        else:
            self._client.set_terminated(self._run_id, commit.status, commit.updated)
        tags = {**_labels(commit), "resumable": str(commit.status in ("KILLED", "FAILED")).lower()}
        if parent_run:
            tags["mlflow.parentRunId"] = parent_run
        if commit.error:
            tags["error"] = commit.error
            if self._traceback.exists():
                self._send_file(TRACEBACK, read_file(self._traceback, SMALL))
        elif "error" in self._client.get_run(self._run_id).data.tags:
            self._client.delete_tag(self._run_id, "error")
        self._send_tags(tags)

    def send(self, record: Params | Tags | Artifact | Image | Model) -> None:
        if isinstance(record, Artifact | Image | Model) and not (self._artifacts / record.path).is_file():
            _log.warning("%s is gone and cannot be published", self._artifacts / record.path)
            return
        if isinstance(record, Artifact | Model) and not is_whole(
            read_file(self._artifacts / record.path, ARTIFACT), record.sha256
        ):
            if isinstance(record, Model):  # else it is newer than this record, and has, or will have, one of its own
                _log.warning("%s is not what was recorded and is not published", self._artifacts / record.path)
            return
        match record:
            case Params(values):
                self._send_params(values)
            case Tags(values):
                self._send_tags(values)
            case Artifact(path):
                self._client.log_artifact(self._run_id, str(self._artifacts / path), os.path.dirname(path))
            case Image():
                self._send_image(record)
            case Model():
                self._send_model(record)

    def _send_params(self, values: dict[str, str]) -> None:
        from mlflow.entities import Param

        values = {key: value[:_PARAM_LENGTH] for key, value in values.items()}
        final = self._client.get_run(self._run_id).data.params
        params = [Param(key, value) for key, value in values.items() if key not in final]
        self._client.log_batch(self._run_id, params=params, synchronous=True)
        self._send_tags({key: value for key, value in values.items() if final.get(key, value) != value})

    def _send_tags(self, values: dict[str, str]) -> None:
        for key, value in values.items():
            self._client.set_tag(self._run_id, key, value, synchronous=True)

    def _send_image(self, record: Image) -> None:
        # `log_image` with a key would name the files at random, so that an image sent again would be a second one.
        name, content = image_name(self._run_id, record), read_file(self._artifacts / record.path, ARTIFACT)
        try:
            small = _shrunk(content)
        except Exception as error:  # whatever PIL makes of it
            raise ValueError(f"{self._artifacts / record.path} is no PNG of a run: {error}") from None
        self._send_file(f"{name}.png", content)
        self._client.log_image(self._run_id, small, f"{name}+compressed.webp")
        self._send_tags({"mlflow.loggedImages": "True"})

    def _send_model(self, record: Model) -> None:
        from mlflow.entities import LoggedModelOutput

        same = f"source_run_id = '{self._run_id}' AND tags.step = '{record.step}'"
        found = self._client.search_logged_models([self._experiment_id], same, max_results=1)
        tags = {"step": str(record.step)}
        name = re.sub("[/:.%\"']", "-", f"{self._name} {record.step}")  # which MLflow takes in no model's name
        create = self._client.create_logged_model
        model_id = (found[0] if found else create(self._experiment_id, name, self._run_id, tags)).model_id
        self._client.log_model_artifact(model_id, str(self._artifacts / record.path))
        self._client.finalize_logged_model(model_id, "READY")
        outputs = self._client.get_run(self._run_id).outputs
        if not outputs or model_id not in {output.model_id for output in outputs.model_outputs}:
            self._client.log_outputs(self._run_id, [LoggedModelOutput(model_id, record.step)])
        self.send_points(self._points(record, model_id))
        if record.best:
            same = f"source_run_id = '{self._run_id}' AND tags.best = 'true'"
            for model in self._client.search_logged_models([self._experiment_id], same):
                if model.model_id != model_id:
                    self._client.delete_logged_model_tag(model.model_id, "best")
            self._client.set_logged_model_tags(model_id, {"best": "true"})


def _shrunk(content: bytes) -> "PIL.Image.Image":
    """A PNG, which alone is tried, as small as MLflow's pages show it at first."""
    from mlflow.tracking.multimedia import compress_image_size
    from PIL.PngImagePlugin import PngImageFile

    with PngImageFile(io.BytesIO(content)) as image:  # reads the head
        if max(image.size) > _PIXELS:
            raise ValueError(f"{image.width:,} x {image.height:,} pixels, more than {_PIXELS:,} a side")
        return compress_image_size(image)


def image_name(run_id: str, record: Image) -> str:
    """Returns the path of an image among its run's artifacts, without its ending, as MLflow's pages look for it."""
    unique = uuid5(UUID(run_id), record.path)
    return f"images/{record.key.replace('/', '~')}+step+{record.step}+timestamp+{record.time}+{unique}"
