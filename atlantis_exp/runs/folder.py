"""Find run folders, and read their files, holders and results."""

import json
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal, Self, TypeVar

from atlantis_exp.checking import nearest, parse
from atlantis_exp.config import Config
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.runs import lock
from atlantis_exp.runs.files import SMALL, Natural, inside, read_file, schema_of, write_file
from atlantis_exp.runs.journal import Commit, Record, Status, has_lost_commit, read, read_commit

CONFIG, RESULT, COMMIT = "config.json", "result.json", "commit.json"
CHECKPOINTS = "checkpoints"  # the folder of a training's
TRACEBACK = "traceback.txt"  # of the run's latest failure
LOOKS = "looks.json"  # of a comparison
OUTPUT = "output.txt"  # of a run that a launcher started

# Artifacts.
EPISODES = "episodes.csv"  # of the training
BEST_EPISODE = "best_episode.mp4"
NETWORK = "network"  # the models that are a training's networks
EVALUATION, EVALUATION_REPORT = "evaluation/episodes.csv", "evaluation/report.txt"  # of an `evaluate` run

TABLE_COLUMNS = ("mean", "standard_error", "median", "interquartile_mean", "high", "low")
"""The columns of a table of scores, in order."""
EVALUATED = {*(f"evaluation/{point}" for point in (*TABLE_COLUMNS, "episodes", "epsilon")), "actions/random_share"}
"""The metrics of an evaluation that tables show."""
LOST = "lost"  # the tag of a run that lost a part of its replay memory, and its bit-for-bit equality
_HOLD_SECONDS = 2.0  # to wait for a run that another command may hold briefly

State = Literal["done", "running", "failed", "interrupted", "queued"]
T = TypeVar("T")


def evaluation_at(step: int) -> str:
    """Return the name of the artifact with the episodes of a training's evaluation at a step."""
    return f"evaluation/{step:09d}.csv"


@dataclass(frozen=True)
class Result:
    """The result of a run: the numbers of its last evaluation and the report's table of them."""

    outcome: str
    steps: Natural
    counts: dict[str, float]  # episodes, frames, updates, FLOPs of updates and hours of a training
    evaluation: dict[str, float]  # empty without one
    report: str
    evaluated_at: Natural | None = None  # step of the last evaluation, if that was before the last one

    def __post_init__(self) -> None:
        if self.evaluation and (missing := EVALUATED - self.evaluation.keys()):
            raise ValueError(f"its evaluation lacks {min(missing)}")

    def spent(self, limits: Mapping[str, float]) -> dict[str, float]:
        """Return the budget's limits that the training has reached."""
        done = {"budget.steps": self.steps, "budget.flops": self.counts.get("flops", 0)}
        return {key: limit for key, limit in limits.items() if done[key] >= limit}


@dataclass(frozen=True)
class RunFolder:
    """A run's folder: it has `config.json` from its start, `result.json` from its end; a damaged file raises Fault."""

    path: Path

    @classmethod
    def of(cls, config: Config) -> Self:
        """Return the folder of a config's training."""
        return cls(Path(config.paths.outputs) / "runs" / config.run_name())

    @property
    def name(self) -> str:
        """The run's name, in UTF-8 even if its folder's name is not."""
        return os.fsencode(self.path.name).decode(errors="replace")

    @property
    def checkpoints(self) -> Path:
        return self.path / CHECKPOINTS

    def artifact(self, name: str) -> Path:
        """Return the file of an artifact. Raises: ValueError if its name leads out of the folder."""
        return inside(self.path / "artifacts", name)

    @property
    def has_started(self) -> bool:
        """Whether there is anything to continue."""
        return (self.path / CONFIG).exists()

    @property
    def config(self) -> dict[str, Any]:
        """The composed config, empty before the run's start."""
        return _read(self.path / CONFIG, dict[str, Any]) or {}

    @property
    def trained_config(self) -> Config:
        """The config of a training run. Raises: ConfigError that names its file."""
        try:
            return parse(Config, self.config)
        except ConfigError as error:
            raise ConfigError(f"{self.path / CONFIG}: {error}") from None

    @property
    def result(self) -> Result | None:
        """The run's result, or None before its end."""
        return _read(self.path / RESULT, Result)

    @property
    def final_result(self) -> Result | None:
        """The run's result; None also while a longer training replaces it."""
        return self.result if self.state == "done" else None

    def ended(self, limits: Mapping[str, float]) -> Result | None:
        """Return the result of an ended run, or None if it can continue, as after a raise of its budget."""
        if not self.has_started or (result := self.result) is None:
            return None
        return None if result.outcome == "budget" and not result.spent(limits) else result

    def beyond(self, limits: Mapping[str, float]) -> tuple[str, str] | None:
        """Return the limit that the training has exceeded and its actual length, or None."""
        if (result := self.result) is None:
            return None
        config = self.trained_config
        # All environments step at once, and then all due updates.
        updates = math.ceil(config.env.num_envs / config.training.learn_every)
        steps, most = limits.get("budget.steps"), limits.get("budget.flops")
        if steps is not None and result.steps - config.env.num_envs >= steps:
            return f"budget.steps={steps}", f"{result.steps:,} steps"
        flops, done = result.counts.get("flops", 0), result.counts.get("updates", 0)
        if most is not None and flops and done and flops * (1 - updates / done) >= most:
            return f"budget.flops={most:g}", f"{flops:.4g} FLOPs"
        return None

    def put_aside(self) -> Path:
        """Rename the folder to make room for a new run; return its new path. Raises: Fault while held."""
        kept = next(path for n in range(1, 10_000) if not (path := self.path.with_name(f"{self.name}~{n}")).exists())
        with self.held():
            return self.path.rename(kept)

    @property
    def has_lost_checkpoints(self) -> bool:
        """Whether the run has commits but no checkpoints, as in a copy without them."""
        commit = self.commit
        was_committed = (commit is not None and commit.offset > 0) or has_lost_commit(self.path)
        return was_committed and not any(self.checkpoints.glob("*/manifest.json"))

    @property
    def commit(self) -> Commit | None:
        """The last commit; None before the first commit or status."""
        return read_commit(self.path)

    def records(self) -> Iterator[Record]:
        """Yield the committed records of the journal. Raises: Fault if it is damaged."""
        try:
            for _, record in read(self.path):
                yield record
        except ValueError as error:
            raise Fault(f"run {self.name}: {error}") from error

    @property
    def title(self) -> str:
        return commit.labels.get("mlflow.runName", self.name) if (commit := self.commit) else self.name

    @property
    def status(self) -> Status | None:
        """The last status written; None before the first."""
        return commit.status if (commit := self.commit) else None

    @property
    def error(self) -> str:
        return commit.error if (commit := self.commit) else ""

    @property
    def parent(self) -> Path | None:
        """The folder of the run's latest sweep."""
        return self.path / commit.parent if (commit := self.commit) and commit.parent else None

    @property
    def state(self) -> State:
        """The run's state; after a kill it is interrupted, whatever the journal says."""
        if not self.has_started:
            return "failed" if self.status == "FAILED" else "queued"
        status = self.status
        if status == "FAILED":
            return "failed"
        if self.result is not None and status not in ("RUNNING", "KILLED"):  # else a longer training replaces it
            return "done"
        has_ended = status not in (None, "SCHEDULED", "RUNNING")
        return "running" if not has_ended and self.is_held else "interrupted"

    @property
    def is_held(self) -> bool:
        return lock.is_held(self.path)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Lock the run against other processes. Raises: Fault that names its holder."""
        with lock.held(self.path, f"run {self.name}", _HOLD_SECONDS):
            yield

    def write_config(self, config: Mapping[str, Any]) -> None:
        write_file(self.path / CONFIG, json.dumps(config, indent=2).encode())

    def write_result(self, result: Result) -> None:
        write_file(self.path / RESULT, json.dumps(asdict(result), indent=2).encode())


def all_folders(outputs: Path) -> list[RunFolder]:
    """Return all folders under `outputs` with a journal: runs, sweeps, searches, evaluations, comparisons."""
    return [RunFolder(path.parent) for path in sorted(outputs.glob(f"*/*/{COMMIT}"))]


def all_runs(outputs: Path) -> list[RunFolder]:
    """Return all runs that have started, by name."""
    return [RunFolder(path.parent) for path in sorted((outputs / "runs").glob(f"*/{CONFIG}"))]


def fits(name: str, patterns: Sequence[str]) -> bool:
    """Return whether a run's name starts with or matches one of the patterns, or there are none.

    A pattern that ends in a seed matches only that seed: `cnn-uniform-s1` does not match s10.
    """
    rests = ("[!0-9]*" if re.search(r"s\d+$", pattern) else "*" for pattern in patterns)
    return not patterns or any(
        fnmatchcase(name, pattern) or fnmatchcase(name, pattern + rest)
        for pattern, rest in zip(patterns, rests, strict=True)
    )


def find_run(outputs: Path, name: str) -> RunFolder:
    """Return the training run of a name, or the only one that a start or pattern of names fits, or the latest.

    A start or pattern fits none that `resume=never` put aside.

    Raises:
        ConfigError: no run or several match.
        Fault: it is damaged.
    """

    def is_training(folder: RunFolder) -> bool:
        try:
            return "model" in folder.config
        except Fault:
            if folder.name == name:
                raise
            return False  # no obstacle to another

    folders = [folder for folder in all_runs(outputs) if is_training(folder)]
    if not folders:
        raise ConfigError(f"run={name}: {outputs / 'runs'} has no training runs")
    if name == "latest":
        return max(folders, key=lambda folder: (folder.path / CONFIG).stat().st_mtime)
    matching = [folder for folder in folders if folder.name == name] or [
        folder for folder in folders if "~" not in folder.name and fits(folder.name, [name])
    ]
    if len(matching) == 1:
        return matching[0]
    if matching:
        raise ConfigError(f"run={name}: could be any of {', '.join(folder.name for folder in matching)}")
    raise ConfigError(f"run={name}: no such run; {nearest(name, {folder.name for folder in folders})}")


def has_ended(config: Config) -> bool:
    """Return whether a config's training has ended and its budget allows no more."""
    return RunFolder.of(config).ended(config.budget.limits) is not None


def _read(path: Path, kind: type[T]) -> T | None:
    try:
        return schema_of(kind).validate_json(read_file(path, SMALL), strict=True) if path.exists() else None
    except ValueError:
        raise Fault(f"{path} is damaged: remove it and repeat the run's command, which rewrites it") from None
