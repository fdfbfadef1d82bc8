"""Run folders: where a run lives, who holds it, and how it ended."""

import fcntl
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, Self, TextIO, TypeVar

from pydantic import TypeAdapter, ValidationError

from atlantis_exp.config import Config, ConfigError, TrackingConfig, flatten, nearest, parse
from atlantis_exp.faults import Fault
from atlantis_exp.media import score_histogram
from atlantis_exp.tracking.journal import Commit, Journal, JournalError, Status, read_commit, write_file
from atlantis_exp.tracking.store import Publisher, Store, brought, unfinished
from atlantis_exp.training.evaluation import Evaluation

_DRAIN_SECONDS = 20.0  # that a command waits for MLflow at its end; `settle` sends what is missing then
_HOLD_SECONDS = 2.0  # that a command waits for a run, which `settle` may hold for a moment
_LIBRARIES = ("atlantis-exp", "ale-py", "gymnasium", "torch", "numpy", "opencv-python-headless", "hydra-core", "mlflow")

State = Literal["done", "running", "failed", "interrupted", "missing"]
T = TypeVar("T")


@dataclass(frozen=True)
class Result:
    """How a run ended: the numbers of its last evaluation and the report's table of them."""

    outcome: str
    steps: int
    counts: dict[str, float]  # episodes, frames, updates and hours of a training
    evaluation: dict[str, float]
    report: str


@dataclass(frozen=True)
class RunFolder:
    """One run's folder: `config.json` at its start, `result.json` at its end, journal and checkpoints in between.

    Reading a file of it that is damaged raises Fault.
    """

    path: Path

    @classmethod
    def of(cls, config: Config) -> Self:
        """The folder of the training that a config is."""
        return cls(Path(config.paths.outputs) / "runs" / config.run_name())

    @property
    def name(self) -> str:
        """The run's name."""
        return self.path.name

    @property
    def has_started(self) -> bool:
        """Whether there is anything to continue."""
        return (self.path / "config.json").exists()

    @property
    def config(self) -> dict[str, Any]:
        """The composed config, empty before the run's start."""
        return _read(self.path / "config.json", _CONFIG) or {}

    @property
    def result(self) -> Result | None:
        """How the run ended, None before its end."""
        return _read(self.path / "result.json", _RESULT)

    @property
    def status(self) -> Status | None:
        """What the run last said of itself, None before it said anything."""
        return commit.status if (commit := self._commit) else None

    @property
    def error(self) -> str:
        """Why the run failed, empty if it did not."""
        return commit.error if (commit := self._commit) else ""

    @property
    def parent(self) -> Path | None:
        """The folder of the sweep that the run was last part of."""
        return self.path / commit.parent if (commit := self._commit) and commit.parent else None

    @property
    def state(self) -> State:
        """How the run stands; one whose process was killed is interrupted, whatever its journal says."""
        if not self.has_started:
            return "failed" if self.status == "FAILED" else "missing"
        if self.result is not None:
            return "done"
        if self.status == "FAILED":
            return "failed"
        has_ended = self.status not in (None, "SCHEDULED", "RUNNING")
        return "running" if not has_ended and self.is_held else "interrupted"

    @property
    def is_held(self) -> bool:
        """Whether a process holds the run."""
        path = self.path / "lock"
        if not path.exists():
            return False
        with open(path, "a+") as file:
            return not _locked(file)

    @property
    def _commit(self) -> Commit | None:
        try:
            return read_commit(self.path)
        except JournalError as error:
            raise Fault(str(error)) from None

    def write_config(self, config: Mapping[str, Any]) -> None:
        """Keep the composed config."""
        write_file(self.path / "config.json", json.dumps(config, indent=2).encode())

    def write_result(self, result: Result) -> None:
        """Keep how the run ended."""
        write_file(self.path / "result.json", json.dumps(asdict(result), indent=2).encode())

    @contextmanager
    def held(self) -> Iterator[None]:
        """Hold the run against other processes. Raises: Fault, naming the one that holds it."""
        self.path.mkdir(parents=True, exist_ok=True)
        with open(self.path / "lock", "a+") as file:
            patience = time.monotonic() + _HOLD_SECONDS
            while not _locked(file):
                if time.monotonic() > patience:
                    file.seek(0)
                    raise Fault(f"run {self.name} is held by {file.read().strip()}", exit_code=75)
                time.sleep(0.05)
            file.truncate(0)
            file.write(f"process {os.getpid()} on {os.uname().nodename}\n")
            file.flush()
            yield  # the kernel lets go when the process ends, however it does


def settle(outputs: Path, continued: Path | None = None) -> None:
    """Say of runs whose process was killed that they are interrupted, and send MLflow what a command had to leave.

    Not sent is the run in the folder `continued`, which its own session will send while it goes on.
    """
    unreachable: set[str] = set()
    for path in sorted(outputs.glob("*/*/commit.json")):
        folder = RunFolder(path.parent)
        try:
            runs_here = folder.status == "RUNNING" and not brought(folder.path)
            if runs_here and not folder.is_held:
                with suppress(Fault), folder.held():
                    Journal(folder.path).status("KILLED")
                    print(f"run {folder.name} was killed; the command that started it continues it")
            is_sent = folder.status == "RUNNING" or folder.path == continued
            store = None if is_sent else unfinished(folder.path, outputs)
        except Fault as fault:
            print(f"atlantis_exp: {fault}", file=sys.stderr)  # no reason to refuse a command for another run
            continue
        if store is None or store.address in unreachable:
            continue
        if not Publisher(folder.path, store).drain(_DRAIN_SECONDS):
            unreachable.add(store.address)


def find_run(outputs: Path, name: str) -> RunFolder:
    """The training run of that name, that start of a name, or the latest. Raises: ConfigError."""
    folders = [folder for folder in all_runs(outputs) if "model" in folder.config]
    if not folders:
        raise ConfigError(f"run={name}: there is no training run under {outputs / 'runs'}")
    if name == "latest":
        return max(folders, key=lambda folder: (folder.path / "config.json").stat().st_mtime)
    matching = [folder for folder in folders if folder.name == name] or [
        folder for folder in folders if folder.name.startswith(name)
    ]
    if len(matching) == 1:
        return matching[0]
    if matching:
        raise ConfigError(f"run={name}: could be any of {', '.join(folder.name for folder in matching)}")
    raise ConfigError(f"run={name}: no such run; {nearest(name, {folder.name for folder in folders})}")


def trained_config(run: RunFolder) -> Config:
    """The config of a training run. Raises: ConfigError, naming its file."""
    try:
        return parse(Config, run.config)
    except ConfigError as error:
        raise ConfigError(f"{run.path / 'config.json'}: {error}") from None


def all_runs(outputs: Path) -> list[RunFolder]:
    """All runs that have started, by name."""
    return [RunFolder(path.parent) for path in sorted((outputs / "runs").glob("*/config.json"))]


def provenance() -> dict[str, str]:
    """What made a run, as tags: code and library versions, and the command line."""
    tags = {f"version.{name}": version(name) for name in _LIBRARIES}
    tags["version.python"] = sys.version.split()[0]
    checkout = Path(__file__).resolve().parents[2]
    if (checkout / ".git").exists():

        def git(*arguments: str) -> str:
            done = subprocess.run(("git", *arguments), cwd=checkout, capture_output=True, text=True, check=False)
            return done.stdout.strip()

        tags["git.commit"] = git("rev-parse", "HEAD")
        tags["git.dirty"] = str(bool(git("status", "--porcelain", "--untracked-files=no"))).lower()
    tags["command"] = " ".join(["python -m atlantis_exp", *sys.argv[1:]])
    return tags


@contextmanager
def published(
    folder: RunFolder,
    tracking: TrackingConfig,
    outputs: Path,
    labels: Mapping[str, str],
    others: Sequence[RunFolder] = (),
) -> Iterator[Journal]:
    """A journal in the run's folder that is mirrored to MLflow while it grows (tracking=mlflow).

    labels: tags that the run bears from its first moment; see `titles.labels`.
    others: runs that other processes write and that are mirrored along.

    Raises:
        Fault: where the folder's journal is damaged.
    """
    try:
        journal = Journal(folder.path, labels)
    except JournalError as error:
        raise Fault(str(error)) from None
    if tracking.name == "none":
        yield journal
        return
    store = Store(outputs, tracking.experiment, tracking.uri)
    publisher = Publisher(folder.path, store, others=[other.path for other in others])
    try:
        yield journal
    finally:
        if not publisher.drain(_DRAIN_SECONDS):
            print(
                f"atlantis_exp: MLflow has not taken all of {folder.name} yet; the run's folder has it", file=sys.stderr
            )


def record_evaluation(
    folder: RunFolder,
    kind: str,
    facts: Mapping[str, Any],
    evaluation: Evaluation,
    video: bytes | None,
    tracking: TrackingConfig,
    outputs: Path,
    labels: Mapping[str, str],
) -> None:
    """Print an evaluation as the report does, and keep it as a run of its own; `facts` are its params."""
    print(f"\n{evaluation.report()}\n")
    with folder.held(), published(folder, tracking, outputs, {**labels, "atlantis.kind": kind}) as journal:
        folder.write_config(facts)
        journal.params({key: str(value) for key, value in flatten(facts).items()})
        journal.tags({**provenance(), "policy": evaluation.policy})
        journal.note(f"    {evaluation.report().replace(chr(10), chr(10) + '    ')}")
        step = int(facts.get("step", 0))
        journal.metrics(evaluation.metrics(), step)
        for index, episode in enumerate(evaluation.episodes):
            journal.metrics({"score/episode": episode.score, "score/length": episode.steps}, index)
        scores = [episode.score for episode in evaluation.episodes]
        journal.image("evaluation/histogram", score_histogram(scores, folder.name), step)
        journal.artifact("evaluation/episodes.csv", evaluation.table().encode())
        journal.artifact("evaluation/report.txt", evaluation.report().encode())
        if video is not None:
            journal.artifact("best_episode.mp4", video)
        journal.state_dict()
        journal.commit()
        journal.status("FINISHED")
        folder.write_result(Result("finished", step, {}, evaluation.metrics(), evaluation.report()))
    print(f"recorded as {folder.name} in {folder.path}")


def _locked(file: TextIO) -> bool:
    """Whether the lock is this process's now; it is until the file is closed."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _read(path: Path, schema: TypeAdapter[T]) -> T | None:
    try:
        return schema.validate_json(path.read_bytes(), strict=True) if path.exists() else None
    except ValidationError:
        raise Fault(f"{path} is damaged: remove it and issue the run's command again, which writes it anew") from None


_RESULT = TypeAdapter(Result)
_CONFIG = TypeAdapter(dict[str, Any])
