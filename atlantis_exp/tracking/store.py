"""Open an MLflow experiment: a database and files in an outputs folder, or a server."""

import logging
import os
import re
import sqlite3
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, TypeVar, cast

from atlantis_exp import terminal
from atlantis_exp.faults import Fault
from atlantis_exp.runs.journal import Commit
from atlantis_exp.runs.lock import alone
from atlantis_exp.terminal import command_line, quoted
from atlantis_exp.tracking import local
from atlantis_exp.tracking.local import DATABASE, Point
from atlantis_exp.tracking.server import PatientClient, TooSlow
from atlantis_exp.tracking.views import experiment_tags

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run
    from mlflow.store.entities import PagedList

P = TypeVar("P")

_log = logging.getLogger(__name__)

IDENTITY, FOLDER, RUN_NAME = "atlantis.identity", "atlantis.folder", "mlflow.runName"
"""Tags of a run: its identity, its folder, and its name."""

_PAGES = 1_000  # of 1,000 runs each, that a server may list
_NAME_LENGTH = 250  # characters of a run's name in a PostgreSQL store
_UNUSABLE = ("not a database", "is malformed", "out-of-date database schema", "Can't locate revision")


class Store:
    """An experiment of the MLflow database in `root`, a folder on a local disk, or of the server at `tracking_uri`.

    Imports MLflow (1-3 s) and creates its tables on first use, in any number of processes at once. A call to a server
    may take `patience` seconds.
    """

    def __init__(
        self, root: Path, experiment: str = "atlantis", tracking_uri: str | None = None, patience: int = 60
    ) -> None:
        self._root = root.resolve()
        self._experiment = experiment
        self._patience = patience
        self.is_local = tracking_uri is None
        self.uri = tracking_uri or f"sqlite:///{self._root / DATABASE}"

    @property
    def client(self) -> "MlflowClient":
        return self._connection[0]

    @property
    def experiment_id(self) -> str:
        """The id of the experiment, created if needed."""
        return self._connection[1]

    @property
    def address(self) -> str:
        """The database or server, and the experiment."""
        return f"{self.uri}#{self._experiment}"

    def runs(self) -> "list[Run]":
        """Return the published runs, the latest first."""
        return all_pages(partial(self.client.search_runs, [self.experiment_id], f"tags.`{FOLDER}` != ''"))

    def prepare(self) -> None:
        """Write the experiment's description and shared views."""
        comparisons = "tags.`atlantis.kind` = 'comparison'"
        newest = self.client.search_runs([self.experiment_id], comparisons, max_results=1)
        place = f"#/experiments/{self.experiment_id}/runs"
        linked = f"[{newest[0].info.run_name}]({place}/{newest[0].info.run_id})" if newest else None
        for key, value in experiment_tags(linked).items():
            self.client.set_experiment_tag(self.experiment_id, key, value)

    def open_run(self, folder: Path, commit: Commit) -> "Run":
        """Return the run that mirrors a folder; create a missing one."""
        same = f"tags.`{IDENTITY}` = '{commit.identity}'"
        if found := self.client.search_runs([self.experiment_id], same, max_results=1):
            return found[0]
        labels = labels_of(commit)
        tags = {IDENTITY: commit.identity, FOLDER: str(folder), **labels}
        return self.client.create_run(self.experiment_id, commit.started, tags, labels.get(RUN_NAME, folder.name))

    def run(self, run_id: str) -> "Run | None":
        """Return a run, or None if it is missing or deleted."""
        from mlflow.exceptions import MlflowException

        try:
            run = self.client.get_run(run_id)
        except MlflowException as error:
            if error.error_code != "RESOURCE_DOES_NOT_EXIST":
                raise
            return None
        return run if run.info.lifecycle_stage == "active" else None

    def delete_run(self, run_id: str) -> None:
        """Delete a run, and its models, which MLflow would keep."""
        same = f"source_run_id = '{run_id}'"
        for model in all_pages(partial(self.client.search_logged_models, [self.experiment_id], same)):
            self.client.delete_logged_model(model.model_id)
        self.client.delete_run(run_id)

    def put(self, run_id: str, path: str, content: bytes, model_id: str = "") -> None:
        """Add a file to a run or to a model."""
        if self.is_local:  # MLflow's client would query the database for each file
            owner = f"models/{model_id}" if model_id else run_id
            place = local.artifacts(self._root, self._experiment) / owner / "artifacts" / path
            place.parent.mkdir(parents=True, exist_ok=True)
            place.unlink(missing_ok=True)  # a copy of the outputs folder may share it as a hard link
            place.write_bytes(content)
            return
        with TemporaryDirectory() as aside:
            file = Path(aside, os.path.basename(path))
            file.write_bytes(content)
            if model_id:
                self.client.log_model_artifact(model_id, str(file))
            else:
                self.client.log_artifact(run_id, str(file), os.path.dirname(path))

    def log_points(self, run_id: str, points: Sequence[Point]) -> None:
        """Add points to a run, each once even if sent again."""
        if self.is_local:
            local.log_points(self._root, run_id, points)
            return
        from mlflow.entities import Metric

        self.client.log_batch(run_id, metrics=[Metric(*point) for point in points], synchronous=True)

    def fault(self, error: Exception) -> Fault | None:
        """Return the store's fault after an error, or None if the published folder is the cause."""
        if isinstance(error, ValueError):  # raised for a folder's own files
            return None
        is_busy = getattr(error, "error_code", "") == "TEMPORARILY_UNAVAILABLE"
        if is_busy or isinstance(error, Fault | TooSlow | sqlite3.Error) or self._is_unusable(error):
            return self.explained(error)
        try:
            self.client.get_experiment(self.experiment_id)
        except Exception as reason:
            return self.explained(reason)
        return None

    def explained(self, error: Exception) -> Fault:
        """Turn a store's error into a fault with its remedy."""
        if isinstance(error, Fault):
            return error
        reason = first_line(error)
        if not self._is_unusable(error):
            return Fault(f"{self.uri} cannot be reached: {reason}")
        again = command_line("sync", f"paths.outputs={quoted(self._root)}")
        return Fault(f"{self._root / DATABASE} cannot be used ({reason}): move it away, and {again} rebuilds it")

    def _is_unusable(self, error: Exception) -> bool:
        return self.is_local and any(reason in str(error) for reason in _UNUSABLE)

    @cached_property
    def _connection(self) -> tuple["MlflowClient", str]:
        os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")  # by default a call may take 246 s
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "10")  # seconds
        os.environ.setdefault("MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT", "true")
        os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
        # Else files would go to any address that the server names.
        os.environ.setdefault("MLFLOW_ENABLE_PROXY_MULTIPART_UPLOAD", "false")
        from mlflow import MlflowClient

        # MLflow's failures reach us as exceptions; its log would add tracebacks.
        logging.getLogger("mlflow").setLevel(logging.CRITICAL)
        logging.getLogger("alembic").setLevel(logging.WARNING)
        with alone(self._root / "mlflow.lock"):  # processes that create the tables together would break them
            if not self.is_local:
                client = cast("MlflowClient", PatientClient(MlflowClient(self.uri), self._patience))
                return client, self._opened_experiment(client)
            try:
                local.make_database(self._root)
                client = MlflowClient(local.uri_of(self._root))
                client.search_experiments(max_results=1)  # MLflow checks the version of the tables
                if before := local.follow(self._root):
                    _log.warning("%s was moved or copied from %s: corrected the paths in its store", self._root, before)
                return client, self._opened_experiment(client)
            except Exception as error:
                local.forget_connections(self._root)
                raise self.explained(error) from None

    def _opened_experiment(self, client: "MlflowClient") -> str:
        """Return the id of the experiment; create a missing one, restore a deleted one."""
        if (experiment := client.get_experiment_by_name(self._experiment)) is None:
            # MLflow's default depends on the working directory of the first process.
            location = local.artifacts(self._root, self._experiment).as_uri() if self.is_local else None
            try:
                return client.create_experiment(self._experiment, location)
            except Exception:
                if (experiment := client.get_experiment_by_name(self._experiment)) is None:
                    raise  # else another machine has created it
        if experiment.lifecycle_stage == "deleted":
            client.restore_experiment(experiment.experiment_id)
            _log.warning("Restored the deleted MLflow experiment %s with its runs", self._experiment)
        return experiment.experiment_id


def labels_of(commit: Commit) -> dict[str, str]:
    """Return a run's labels, with its name cut to a store's limit."""
    return {key: text[:_NAME_LENGTH] if key == RUN_NAME else text for key, text in commit.labels.items()}


def first_line(error: Exception) -> str:
    """Return an error's first line."""
    text = str(error) if isinstance(error, Fault) else f"{type(error).__name__}: {error}"
    reason = re.search(r"\(sqlite3\.\w+\) .*", text)  # SQLAlchemy puts advice above it
    return terminal.harmless(reason[0] if reason else text.partition("\n")[0])


def all_pages(search: "Callable[..., PagedList[P]]") -> list[P]:
    """Return all results of a search. Raises: ValueError for too many pages."""
    found: list[P] = []
    token: str | None = None
    for _ in range(_PAGES):
        page = search(page_token=token)
        found += page
        if not (token := page.token):
            return found
    raise ValueError(f"the server lists more than {_PAGES:,} pages")
