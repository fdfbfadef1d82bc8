"""Read run folders; name those that cannot be read, with reasons."""

import csv
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite, nan
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from atlantis_exp.checking import flatten, nearest, parse, to_dict
from atlantis_exp.components import Component, facts_of, game_of
from atlantis_exp.config import Config
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.games import Game
from atlantis_exp.runs.episodes import EpisodeTable
from atlantis_exp.runs.facts import read_facts, read_tags
from atlantis_exp.runs.folder import BEST_EPISODE, EVALUATION, RESULT, RunFolder, fits
from atlantis_exp.runs.journal import curve
from atlantis_exp.statistics import interquartile_mean

Array = npt.NDArray[np.float64]

AXES = {"frames": "equal frames", "hours": "equal hours", "flops": "equal gradient FLOPs"}
"""The three fair views, by column of a learning curve."""

_CURVE = {
    "frames": "throughput/frames",
    "hours": "throughput/hours",
    "updates": "learning/updates",
    "epsilon": "actions/epsilon",
    "score": "score/mean_100",
}

PUT_ASIDE = "put aside by resume=never"
NOT_STARTED = "foreign: it has no config.json"
"""Reasons to leave out an undamaged folder."""
UNREADABLE = (Fault, ValueError, KeyError, TypeError, AttributeError, OSError, OverflowError, csv.Error)
"""The errors of a damaged folder."""
_OWN_EVALUATION = re.compile(r"evaluation/(\d{1,18})\.csv")


@dataclass(frozen=True)
class Evaluated:
    """An evaluation of a run, by its training or by the verb `evaluate`."""

    folder: RunFolder  # that holds it
    artifact: str  # the table of its episodes
    source: str  # training, evaluate, baseline or human
    step: int
    epsilon: float  # NaN without a network
    seed: int | None

    @property
    def path(self) -> Path:
        """The table of its episodes."""
        return self.folder.artifact(self.artifact)


@dataclass(frozen=True)
class Run:
    """A run by its config and tags, for selecting and grouping."""

    name: str
    config: dict[str, Any]  # dotted keys
    tags: dict[str, str]  # device, precision, git.commit, versions

    @property
    def facts(self) -> dict[str, Any]:
        """Config and tags; the config wins, except for `device`, since the tag resolves `auto`."""
        return {**self.tags, **self.config, **{key: value for key, value in self.tags.items() if key == "device"}}

    @property
    def game(self) -> Component | None:
        """The game; None if its plugin is not loaded."""
        return game_of(str(self.config.get("env.id")))


@dataclass(frozen=True)
class StoredRun(Run):
    """A run folder, finished or not, read as far as selecting needs."""

    folder: RunFolder
    trained: Config | None  # None for a player: a baseline, a person or exported weights
    evaluations: list[Evaluated]  # its own by step, then those of the verb `evaluate` by age


@dataclass(frozen=True)
class Training(Run):
    """A finished training, with its learning curve and its evaluation after the last step.

    Its config has that evaluation's epsilon, and the budget's limits that ended the training.
    """

    science: dict[str, Any]  # the keys that decide its numbers, dotted
    curve: dict[str, Array]  # frames, hours, flops (where recorded), epsilon, score (mean of the last 100 episodes)
    episodes: EpisodeTable
    policy: str = ""  # the network's most frequent action, in words; empty if not recorded
    film: Path | None = None  # of one of these episodes
    training_score: float | None = None  # its score for score=training

    @property
    def score(self) -> float:
        """The score that it counts by."""
        return interquartile_mean(self.episodes.scores) if self.training_score is None else self.training_score


@dataclass(frozen=True)
class Player(Run):
    """A baseline, a person or exported weights, not trained here."""

    episodes: EpisodeTable
    film: Path | None = None  # of one of these episodes

    @property
    def called(self) -> str:
        """Its name for people."""
        if "weights" in self.config:
            return f"weights {self.config['weights']}"
        if "player" in self.config:
            return f"{self.config['player']} (human)"
        if self.config["agent.name"] == "constant":
            return f"{self.episodes.actions[self.config['agent.action']]} held"
        return "random player"


@dataclass
class Stored:
    """The runs of an outputs folder, and reasons by the names of those left out."""

    runs: list[StoredRun] = field(default_factory=list)
    exported: list[StoredRun] = field(default_factory=list)  # weights, one for the latest evaluation at each epsilon
    skipped: dict[str, str] = field(default_factory=dict)


@dataclass
class Gathered:
    """The finished runs of an outputs folder, and reasons by the names of those left out."""

    trainings: list[Training] = field(default_factory=list)
    players: list[Player] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)
    lost: list[StoredRun] = field(default_factory=list)  # trainings among `skipped`: unfinished, or without a score


class _Unusable(ValueError):
    """The reason why an undamaged folder cannot be used."""


def read_runs(outputs: Path, runs: Sequence[str] = (), put_aside: bool = False) -> Stored:
    """Read configs, tags and evaluations of all runs under `outputs`, without their episodes and curves.

    Args:
        runs: names, starts of names, patterns or a decision's name; empty for all. Players are always read.
        put_aside: whether to read runs that resume=never put aside.
    """
    patterns, stored = named_by(outputs, runs), Stored()
    later = _evaluations(outputs, stored)
    for folder in [RunFolder(path) for path in sorted((outputs / "runs").glob("*")) if path.is_dir()]:
        is_asked = fits(folder.name, patterns)
        try:
            if "~" in folder.name and not put_aside:
                raise _Unusable(PUT_ASIDE)
            if not folder.has_started:
                raise _Unusable(f"failed: {folder.error}" if folder.status == "FAILED" else NOT_STARTED)
            tree = folder.config
            if is_asked or "model" not in tree:
                stored.runs.append(_open(folder, tree, later[folder.name]))
        except UNREADABLE as error:
            if is_asked:
                stored.skipped[folder.name] = _reason(error)
    return stored


def _open(folder: RunFolder, tree: dict[str, Any], later: Sequence[Evaluated]) -> StoredRun:
    facts = read_facts(folder.path)
    if "model" in tree:
        trained = parse(Config, tree)
        of = trained.evaluation.epsilon, trained.evaluation.seed
        steps = [(name, int(own[1])) for name in facts.artifacts if (own := _OWN_EVALUATION.fullmatch(name))]
        evaluations = [Evaluated(folder, name, "training", step, *of) for name, step in steps]
        evaluations += [each for each in later if not is_of_another(each.folder, folder)]
        return StoredRun(folder.name, flatten(to_dict(trained)), facts.tags, folder, trained, evaluations)
    if "agent" in tree or "player" in tree:
        config, source = flatten(tree), facts.tags.get("atlantis.kind", "baseline")
        seed = config.get("evaluation.seed")
        evaluations = [Evaluated(folder, EVALUATION, source, 0, nan, seed)] if EVALUATION in facts.artifacts else []
        return StoredRun(folder.name, config, facts.tags, folder, None, evaluations)
    raise _Unusable("foreign: its config.json is not one of ours")


def _evaluations(outputs: Path, stored: Stored) -> dict[str, list[Evaluated]]:
    """Return the finished evaluations by run, the oldest first; add those of exported weights to `stored`."""
    found: list[tuple[int, dict[str, Any], Evaluated]] = []
    for path in sorted((outputs / "evaluations").glob(f"*/{RESULT}")):
        folder = RunFolder(path.parent)
        try:
            facts, commit = folder.config, folder.commit
            if commit is None or not {"run", "weights"} & facts.keys():
                continue
            if not isfinite(epsilon := float(facts["evaluation"]["epsilon"])):
                raise ValueError("its epsilon is not a number")
            step = int(facts["step"]) if "run" in facts else 0
            each = Evaluated(folder, EVALUATION, "evaluate", step, epsilon, facts["evaluation"].get("seed"))
            found.append((commit.updated, facts, each))
        except UNREADABLE as error:
            stored.skipped[f"evaluations/{folder.name}"] = _reason(error)
    trained: dict[str, list[Evaluated]] = defaultdict(list)
    exported: dict[tuple[str, float], StoredRun] = {}
    for _, facts, each in sorted(found, key=itemgetter(0)):
        if "run" in facts:
            trained[str(facts["run"])].append(each)
        else:
            run = StoredRun(each.folder.name, flatten(facts), {}, each.folder, None, [each])
            exported[str(facts.get("sha256")), each.epsilon] = run
    stored.exported = [*exported.values()]
    return trained


def _reason(error: Exception) -> str:
    if isinstance(error, _Unusable):
        return str(error)
    return f"broken: {'it lacks ' if isinstance(error, KeyError) else ''}{error}"


def gather(outputs: Path, runs: Sequence[str] = (), epsilon: float | None = None, put_aside: bool = False) -> Gathered:
    """Read all finished trainings and players under `outputs`; `runs` and `put_aside` as for `read_runs`.

    A training's episodes are those of the latest evaluation after its last step, by itself or by the verb `evaluate`;
    given `epsilon`, of the latest one at that epsilon.
    """
    stored, patterns = read_runs(outputs, runs, put_aside), named_by(outputs, runs)
    gathered = Gathered(skipped=stored.skipped)
    for run in (*stored.runs, *stored.exported):
        try:
            if run.trained is None:
                gathered.players.append(_player(run))
            else:
                gathered.trainings.append(_training(run, run.trained, epsilon))
        except UNREADABLE as error:
            if run.trained is not None:
                gathered.lost.append(run)
            if fits(run.name, patterns):
                gathered.skipped[run.name] = _reason(error)
    return gathered


def _training(run: StoredRun, config: Config, epsilon: float | None) -> Training:
    folder = run.folder
    if folder.result is None:
        state = f"failed: {folder.error}" if folder.state == "failed" else "unfinished"
        raise _Unusable(f"{state}: the command that started it continues it")
    if (result := folder.ended(config.budget.limits)) is None:
        raise _Unusable("unfinished: its limits were raised; the command that raised them continues it")
    at_end = [each for each in run.evaluations if each.step == result.steps and each.path.exists()]
    if not (taken := [each for each in at_end if epsilon in (None, each.epsilon)]):
        wanted = "" if epsilon is None else f" at epsilon {epsilon}"
        raise _Unusable(f"no evaluation{wanted} after its last step: evaluate run={folder.name} makes one")
    latest = taken[-1]
    is_own = latest.folder == folder
    is_filmed = not is_own or run.tags.get("best_evaluation", "").endswith(f" at step {result.steps}")
    science = config.science()
    science["phase"] = {str(index): phase for index, phase in enumerate(science["phase"])}
    spent = result.spent(config.budget.limits) if result.outcome == "budget" else {}
    return Training(
        folder.name,
        run.config | {"evaluation.epsilon": latest.epsilon, "budget.steps": None, "budget.flops": None} | spent,
        run.tags,
        science=flatten(science),
        curve=_curve(folder.path, run.tags),
        episodes=_episodes(latest, facts_of(run.game)),
        policy=(run.tags if is_own else read_tags(latest.folder.path)).get("policy", ""),
        film=latest.folder.artifact(BEST_EPISODE) if is_filmed else None,
    )


def _player(run: StoredRun) -> Player:
    if run.folder.result is None or not run.evaluations:
        raise _Unusable("unfinished: the command that started it continues it")
    episodes = _episodes(run.evaluations[-1], Game())
    return Player(run.name, run.config, run.tags, episodes, run.folder.artifact(BEST_EPISODE))


def _curve(folder: Path, tags: Mapping[str, str]) -> dict[str, Array]:
    recorded = curve(folder, (_CURVE["frames"], _CURVE["score"]))
    points = np.array([[point.values[key] for key in _CURVE.values()] for point in recorded])
    arrays = dict(zip(_CURVE, points.T, strict=True)) if len(points) else {}
    if (updates := arrays.pop("updates", None)) is not None and "flops_per_update" in tags:
        arrays["flops"] = updates * float(tags["flops_per_update"])
    return arrays


def _episodes(evaluated: Evaluated, game: Game) -> EpisodeTable:
    """Read an evaluation's episodes, with the points of the game's sources. Raises: ValueError, OSError."""
    episodes = EpisodeTable.read(evaluated.path, game.sources)
    if game.actions and episodes.actions != game.actions:
        raise ValueError(f"{evaluated.path} has other actions than the game")
    return episodes


def is_of_another(evaluation: RunFolder, run: RunFolder) -> bool:
    """Return whether an evaluation is older than the run: it belongs to one of that name that was put aside."""
    made, begun = evaluation.commit, run.commit
    return made is not None and begun is not None and made.updated < begun.started


def named_by(outputs: Path, runs: Iterable[str]) -> list[str]:
    """Return `runs` with each decision's name, start or pattern replaced by the names of its runs.

    Raises: Fault if a decision's folder is damaged.
    """
    folders = {path.name: RunFolder(path) for path in (outputs / "decisions").glob("decide-*")}
    patterns: list[str] = []
    for text in runs:
        meant = [folder for name, folder in folders.items() if text.startswith("decide-") and fits(name, [text])]
        found = [folder.config.get("runs") for folder in meant]
        names = [run for of in found if isinstance(of, list) for run in of if isinstance(run, str)]
        patterns += names or [text]
    return patterns


def refuse_unknown(outputs: Path, runs: Iterable[str]) -> None:
    """Raise ConfigError for an item of `runs` that matches no run."""
    names = [path.name for path in (outputs / "runs").glob("*") if path.is_dir()]
    for text in runs if names else ():
        patterns = named_by(outputs, [text])
        if not any(fits(name, patterns) for name in names):
            raise ConfigError(f"runs={text}: no such run under {outputs / 'runs'}; {nearest(text, names)}")
