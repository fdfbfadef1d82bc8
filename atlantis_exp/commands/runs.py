"""Run folders: where a run lives, who holds it, and how it ended."""

import fcntl
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, TextIO, get_args

from atlantis_exp.config import ConfigError, TrackingConfig, flatten, nearest
from atlantis_exp.faults import Fault
from atlantis_exp.media import score_histogram
from atlantis_exp.tracking.journal import Journal, read_commit, write_file
from atlantis_exp.tracking.store import Publisher, Store
from atlantis_exp.training.evaluation import Evaluation

_DRAIN_SECONDS = 20.0  # that a command waits for MLflow at its end; `settle` sends what is missing then
_HOLD_SECONDS = 2.0  # that a command waits for a run, which `settle` may hold for a moment
_LIBRARIES = ("atlantis-exp", "ale-py", "gymnasium", "torch", "numpy", "opencv-python-headless", "hydra-core", "mlflow")

State = Literal["done", "running", "failed", "interrupted", "missing"]


@dataclass(frozen=True)
class RunFolder:
    """One run's folder: `config.json` at its start, `result.json` at its end, journal and checkpoints in between."""

    path: Path

    @property
    def name(self) -> str:
        """The run's name."""
        return self.path.name

    @property
    def config(self) -> dict[str, Any] | None:
        """The composed config, None before the run's start."""
        return _read_json(self.path / "config.json")

    @property
    def result(self) -> dict[str, Any] | None:
        """How the run ended, None before its end."""
        return _read_json(self.path / "result.json")

    @property
    def state(self) -> State:
        """How the run stands; one whose process was killed is interrupted, whatever its journal says."""
        if self.result is not None:
            return "done"
        if self.config is None:
            return "missing"
        commit = read_commit(self.path)
        if commit is not None and commit.status == "FAILED":
            return "failed"
        return "running" if commit is not None and commit.status == "RUNNING" and self._is_held() else "interrupted"

    def _is_held(self) -> bool:
        path = self.path / "lock"
        if not path.exists():
            return False
        with open(path, "a+") as file:
            return not _locked(file)

    def write_config(self, config: Mapping[str, Any]) -> None:
        """Keep the composed config."""
        write_file(self.path / "config.json", json.dumps(config, indent=2).encode())

    def write_result(self, result: Mapping[str, Any]) -> None:
        """Keep how the run ended."""
        write_file(self.path / "result.json", json.dumps(result, indent=2).encode())

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


def settle(outputs: Path) -> None:
    """Say of runs whose process was killed that they are interrupted, and send MLflow what a command had to leave."""
    for path in sorted((outputs / "runs").glob("*/commit.json")):
        folder, commit = RunFolder(path.parent), read_commit(path.parent)
        if commit is not None and commit.status == "RUNNING" and not folder._is_held():
            with suppress(Fault), folder.held():
                Journal(folder.path).status("KILLED")
                print(f"run {folder.name} was killed; the command that started it continues it")
        mirrored = _read_json(folder.path / "published.json")
        commit = read_commit(folder.path)
        if mirrored is None or commit is None or commit.status == "RUNNING":
            continue
        if (mirrored["identity"], mirrored["offset"], mirrored["status"]) != (
            commit.identity,
            commit.offset,
            commit.status,
        ):
            publisher = Publisher(folder.path, Store(outputs, mirrored["store"].rpartition("#")[2]))
            publisher.drain(_DRAIN_SECONDS)


@contextmanager
def ledger(folders: Sequence[RunFolder]) -> Iterator[None]:
    """A sweep's table of runs, before and after it."""
    _print_table(folders)
    try:
        yield
    finally:
        _print_table(folders)


def _print_table(folders: Sequence[RunFolder]) -> None:
    states = [folder.state for folder in folders]
    for folder, state in zip(folders, states, strict=True):
        print(f"  {state:12}{folder.name}")
    counts = ", ".join(f"{states.count(state)} {state}" for state in get_args(State) if state in states)
    print(f"sweep of {len(folders)} runs: {counts}", flush=True)


def find_run(outputs: Path, name: str) -> RunFolder:
    """The training run of that name, that start of a name, or the latest. Raises: ConfigError."""
    folders = [folder for folder in all_runs(outputs) if "model" in (folder.config or {})]
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
def published(folder: RunFolder, tracking: str, outputs: Path, experiment: str) -> Iterator[Journal]:
    """A journal in the run's folder that is mirrored to the local MLflow store while it grows (tracking=mlflow)."""
    journal = Journal(folder.path)
    if tracking == "none":
        yield journal
        return
    publisher = Publisher(folder.path, Store(outputs, experiment))
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
) -> None:
    """Print an evaluation as the report does, and keep it as a run of its own; `facts` are its params."""
    print(f"\n{evaluation.report()}\n")
    with folder.held(), published(folder, tracking.name, outputs, tracking.experiment) as journal:
        folder.write_config(facts)
        journal.params({key: str(value) for key, value in flatten(facts).items()})
        journal.tags({**provenance(), "atlantis.kind": kind})
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
        folder.write_result(
            {
                "outcome": "finished",
                "steps": step,
                "evaluation": evaluation.metrics(),
                "report": evaluation.report(),
            }
        )
    print(f"recorded as {folder.name} in {folder.path}")


def _locked(file: TextIO) -> bool:
    """Whether the lock is this process's now; it is until the file is closed."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _read_json(path: Path) -> dict[str, Any] | None:
    if not path.exists():
        return None
    content: dict[str, Any] = json.loads(path.read_text())
    return content
