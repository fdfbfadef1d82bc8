"""Run folders to runs that can be compared; what cannot be is named with its reason."""

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from atlantis_exp.checking import flatten, nearest, parse, to_dict
from atlantis_exp.components import Component, facts_of, game_of, title_of
from atlantis_exp.config import Config
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.games import Game
from atlantis_exp.runs.episodes import EpisodeTable
from atlantis_exp.runs.facts import read_tags
from atlantis_exp.runs.folder import BEST_EPISODE, EVALUATION, RESULT, RunFolder, evaluation_at
from atlantis_exp.runs.journal import curve

Array = npt.NDArray[np.float64]

PROTOCOL = (
    *("env.id", "env.frameskip", "env.sticky", "env.max_frames", "env.max_steps", "env.noop_max", "env.max_pool"),
    *("env.crop", "evaluation.epsilon"),
)
"""What must be equal for scores to mean the same; the observation's size belongs to the network."""

AXES = {"frames": "equal frames", "hours": "equal hours", "flops": "equal gradient FLOPs"}
"""The three fair views: column of a learning curve to what is equal."""

_CURVE = {
    "frames": "throughput/frames",
    "hours": "throughput/hours",
    "updates": "learning/updates",
    "epsilon": "actions/epsilon",
    "score": "score/mean_100",
}
_POINT = ("throughput/frames", "score/mean_100")  # what tells a point of the curve from other metrics

COMMIT = "git.commit"
"""The key whose values are commits."""
_COMMIT_DIGITS = 10

_PLAYERS = ("agent", "player")  # the config's key of what has no network: a baseline, a person


@dataclass(frozen=True)
class Training:
    """A finished training: its config, its learning curve and its evaluation after the last step."""

    name: str
    config: dict[str, Any]  # dotted keys; the epsilon of the evaluation taken, and the budget if it ended the training
    science: dict[str, Any]  # the dotted keys that decide its numbers
    curve: dict[str, Array]  # frames, hours, flops (where recorded), epsilon, score (mean of the last 100 episodes)
    episodes: EpisodeTable
    tags: dict[str, str]  # what the run says about itself: device, precision, git.commit, versions
    policy: str  # in words, what the network did most in these episodes; empty where nobody said
    film: Path | None = None  # of one of these episodes, if there is one

    @property
    def facts(self) -> dict[str, Any]:
        """All that runs can be told apart by: the config and, where it has no such key, the tags.

        The device is the tag's: that which the config's `auto` has become.
        """
        device = {key: value for key, value in self.tags.items() if key == "device"}
        return {**self.tags, **self.config, **device}

    @property
    def game(self) -> Component | None:
        """The game; None where it is a plugin's that no command line names."""
        return game_of(self.config["env.id"])

    @property
    def has_collapsed(self) -> bool:
        """Whether the network chose one action only."""
        return self.policy.startswith("collapsed")


@dataclass(frozen=True)
class Player:
    """A baseline, a person or exported weights: what was not trained here."""

    name: str
    config: dict[str, Any]  # dotted keys
    episodes: EpisodeTable
    film: Path | None = None  # of one of these episodes, if there is one

    @property
    def called(self) -> str:
        """How people call it."""
        if "weights" in self.config:
            return f"weights {self.config['weights']}"
        if "player" in self.config:
            return f"{self.config['player']} (human)"
        if self.config["agent.name"] == "constant":
            return f"{self.episodes.actions[self.config['agent.action']]} held"
        return "random player"


class _Later(NamedTuple):
    """An evaluation that the verb `evaluate` made of a training."""

    made: int  # ms since 1970
    step: int
    epsilon: float
    folder: RunFolder


@dataclass
class Gathered:
    """What the outputs folder holds, and what of it was left aside: a folder's name to the reason."""

    trainings: list[Training] = field(default_factory=list)
    players: list[Player] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)


class _Unusable(ValueError):
    """A run that cannot be compared, and why."""


def gather(outputs: Path, runs: Sequence[str] = (), epsilon: float | None = None, put_aside: bool = False) -> Gathered:
    """Read all finished runs under `outputs`, trainings only if their name begins with or fits one of the `runs`.

    A training's episodes are those of its latest evaluation after its last step, be it the training's own or one that
    the verb `evaluate` made; given `epsilon`, of the latest at that epsilon. What resume=never put aside is left out
    unless it is asked for, as it is where commits are compared: it is what an earlier one made of the same recipe.
    The name of a decision among `runs` stands for the runs that it rests on. Exported weights are players by their
    latest evaluation.
    """
    patterns = named_by(outputs, runs)

    def is_asked_for(name: str) -> bool:
        return not runs or fits(name, patterns)

    gathered = Gathered()
    evaluations, exported = _evaluations(outputs, gathered.skipped)
    gathered.players += exported
    for folder in [RunFolder(path) for path in sorted((outputs / "runs").glob("*")) if path.is_dir()]:
        is_asked = is_asked_for(folder.name)
        try:
            tree = _config(folder, put_aside)
            if any(key in tree for key in _PLAYERS):
                gathered.players.append(_player(folder, tree))
                continue
            if not is_asked:
                continue
            gathered.trainings.append(_training(folder, parse(Config, tree), evaluations.get(folder.name, []), epsilon))
        except (Fault, ValueError, KeyError, TypeError, OSError) as error:
            if is_asked:
                gathered.skipped[folder.name] = f"{'' if isinstance(error, _Unusable) else 'broken: '}{error}"
    return gathered


def named_by(outputs: Path, runs: Iterable[str]) -> list[str]:
    """The names, their starts and patterns that `runs` is; a decision's name is those of its runs. Raises: Fault."""
    return [pattern for text in runs for pattern in _runs_of_decision(outputs, text) or [text]]


def fits(name: str, patterns: Iterable[str]) -> bool:
    """Whether a run's name begins with or fits one of the patterns."""
    return any(fnmatchcase(name, f"{pattern}*") for pattern in patterns)


def refuse_unknown(outputs: Path, runs: Iterable[str]) -> None:
    """Raise ConfigError where a text of `runs` fits no run that is there."""
    names = [path.name for path in (outputs / "runs").glob("*") if path.is_dir()]
    for text in runs if names else ():
        patterns = named_by(outputs, [text])
        if not any(fits(name, patterns) for name in names):
            raise ConfigError(f"runs={text}: no such run under {outputs / 'runs'}; {nearest(text, names)}")


def _runs_of_decision(outputs: Path, name: str) -> list[str]:
    """The runs that a decision rests on, none where there is no decision of that name. Raises: Fault."""
    folders = [RunFolder(path) for path in (outputs / "decisions").glob("decide-*") if path.name == name]
    found = [folder.config.get("runs") for folder in folders]
    return [run for runs in found if isinstance(runs, list) for run in runs if isinstance(run, str)]


def select(trainings: Iterable[Training], where: Sequence[str]) -> list[Training]:
    """The trainings whose configs hold all of KEY=VALUE, with keys as `group` takes them. Raises: ConfigError."""
    selected = list(trainings)
    for text in where:
        key, equals, value = text.partition("=")
        if not equals:
            raise ConfigError(f"where={text}: write KEY=VALUE, as in where=model=cnn,seed=0")
        _check_key("where", key, selected)
        selected = [run for run in selected if _is(run.facts.get(resolve(key, run.facts)), value)]
    return selected


def group(trainings: Iterable[Training], by: Sequence[str]) -> dict[str, list[Training]]:
    """Trainings by the values of config keys or tags, `model` being short for `model.name`; in order of their labels.

    Raises:
        ConfigError: on a key that no training has.
    """
    trainings = list(trainings)
    for key in by:
        _check_key("by", key, trainings)
    groups = defaultdict(list)
    for training in trainings:
        groups[" ".join(values_of(training, by)) or "all"].append(training)
    return dict(sorted(groups.items()))


def values_of(training: Training, by: Sequence[str]) -> tuple[str, ...]:
    """How people call a training's value of each key; a commit by its first digits."""
    return values_in(training.facts, by)


def values_in(facts: Mapping[str, Any], by: Sequence[str]) -> tuple[str, ...]:
    """How people call the value of each key in a training's facts."""
    values = []
    for key in by:
        name = resolve(key, facts)
        value = facts.get(name)
        text = value if isinstance(value, str) else f"{name.rsplit('.')[-1] or key}={json.dumps(value)}"
        values.append(text[:_COMMIT_DIGITS] if name == COMMIT else text)
    return tuple(values)


def resolve(key: str, config: Mapping[str, Any]) -> str:
    """The dotted key that a short one means in a config, empty if there is none: `model` for `model.name`."""
    return next((name for name in (key, f"{key}.name", f"{key}.id") if name in config), "")


def shortened(keys: Iterable[str], facts: Mapping[str, Any]) -> tuple[str, ...]:
    """Keys as people call them, each once: `model` for `model.name`; in alphabetical order of the whole ones."""
    short = []
    for key in sorted(keys, key=lambda key: resolve(key, facts)):
        stem = key.removesuffix(".name").removesuffix(".id")
        short.append(stem if resolve(stem, facts) == key else key)
    return tuple(dict.fromkeys(short))


def mixed_protocol(configs: Mapping[str, Mapping[str, Any]], by: Sequence[str]) -> tuple[str, str] | None:
    """What of the protocol differs, `game` or a key, and a sentence of it; None where scores mean the same.

    What is asked by the keys of `by` may differ, but for the game.

    Args:
        configs: by the names of runs or contenders, with dotted keys.
    """
    games = {name: title_of(config["env.id"]) for name, config in configs.items()}
    if len(set(games.values())) > 1:
        return "game", f"env.id differs: scores of different games are not compared: {_holders(games)}"
    asked = {resolve(key, config) for key in by for config in configs.values()}
    for key in PROTOCOL:
        values = {name: json.dumps(config[key]) for name, config in configs.items()}
        if key not in asked and len(set(values.values())) > 1:
            return key, f"{key} differs, so the scores do not mean the same: {_holders(values)}"
    return None


def refuse_mixed_protocols(trainings: Sequence[Training], by: Sequence[str]) -> None:
    """Raise ConfigError where the scores of trainings do not mean the same, though not because of a key of `by`."""
    if (mixed := mixed_protocol({training.name: training.config for training in trainings}, by)) is None:
        return
    key, sentence = mixed
    hints = {
        "game": "choose with runs= or where=env.id=ID",
        "evaluation.epsilon": (
            "at_epsilon=VALUE takes evaluations at that one, `evaluate run=NAME epsilon=VALUE` makes them"
        ),
    }
    raise ConfigError(f"{sentence}; {hints.get(key, f'choose with runs= or where=, or ask for it with by={key}')}")


def _holders(values: Mapping[str, str]) -> str:
    """Whose value is which."""
    names = defaultdict(list)
    for name, value in values.items():
        names[value].append(name)
    return "; ".join(
        f"{value} in {first}{f' and {len(others)} more' if others else ''}"
        for value, (first, *others) in sorted(names.items())
    )


def plays_alike(player: Player, trainings: Iterable[Training]) -> bool:
    """Whether the game of all is the same; a crop belongs to a network, and a player without one has no epsilon."""
    keys = set(PROTOCOL) - {"env.crop"}
    if "weights" not in player.config:
        keys -= {"evaluation.epsilon"}
    return all(player.config.get(key) == training.config[key] for training in trainings for key in keys)


def _check_key(option: str, key: str, trainings: Sequence[Training]) -> None:
    if trainings and not any(resolve(key, training.facts) for training in trainings):
        raise ConfigError(f"{option}={key}: no such key; {nearest(key, {k for run in trainings for k in run.facts})}")


def _is(value: Any, text: str) -> bool:
    """Whether a person may write a value so: as Python or YAML print it, a number in any way."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        with suppress(ValueError):
            return float(text) == value
    if isinstance(value, list):
        return "".join(text.split()) in (str(value).replace(" ", ""), json.dumps(value, separators=(",", ":")))
    return text in (str(value), json.dumps(value))


def _config(folder: RunFolder, put_aside: bool) -> dict[str, Any]:
    """The config of a folder that holds a finished run of ours."""
    if "~" in folder.name and not put_aside:
        raise _Unusable("put aside by resume=never")
    if not folder.has_started:
        raise _Unusable("foreign: it has no config.json")
    tree = folder.config
    if not any(key in tree for key in ("model", *_PLAYERS)):
        raise _Unusable("foreign: its config.json is not one of ours")
    if folder.result is None:
        raise _Unusable("unfinished: the command that started it continues it")
    return tree


def is_of_another(evaluation: RunFolder, run: RunFolder) -> bool:
    """Whether an evaluation is older than a run: of one of the same name, which `resume=never` put aside."""
    made, begun = evaluation.commit, run.commit
    return made is not None and begun is not None and made.updated < begun.started


def _training(
    folder: RunFolder,
    config: Config,
    evaluations: Sequence[_Later],
    epsilon: float | None,
) -> Training:
    points = np.array([[record.values[key] for key in _CURVE.values()] for record in curve(folder.path, _POINT)])
    arrays = dict(zip(_CURVE, points.T, strict=True)) if len(points) else {}
    tags = read_tags(folder.path)
    if (updates := arrays.pop("updates", None)) is not None and "flops_per_update" in tags:
        arrays["flops"] = updates * float(tags["flops_per_update"])

    if (result := folder.ended(config.budget.steps)) is None:
        raise _Unusable("unfinished: it was made longer; the command that did so continues it")
    steps = result.steps
    tables = [(config.evaluation.epsilon, folder, folder.artifact(evaluation_at(steps)))]
    tables += [
        (later.epsilon, later.folder, later.folder.artifact(EVALUATION))
        for later in evaluations
        if later.step == steps and not is_of_another(later.folder, folder)
    ]
    tables = [table for table in tables if table[2].exists() and epsilon in (None, table[0])]
    if not tables:
        wanted = "" if epsilon is None else f" at epsilon {epsilon}"
        raise _Unusable(f"no evaluation{wanted} after its last step: evaluate run={folder.name} makes one")
    taken, player, path = tables[-1]
    policy = (tags if player == folder else read_tags(player.path)).get("policy", "")
    science = config.science()
    science["phase"] = {str(index): phase for index, phase in enumerate(science["phase"])}
    budget = config.budget.steps if result.outcome == "budget" else None
    leaves = flatten(to_dict(config)) | {"evaluation.epsilon": taken, "budget.steps": budget}
    episodes = _episodes(path, facts_of(config.env.game))
    is_filmed = player != folder or tags.get("best_evaluation", "").endswith(f" at step {steps}")
    film = player.artifact(BEST_EPISODE) if is_filmed else None
    return Training(folder.name, leaves, flatten(science), arrays, episodes, tags, policy, film)


def _player(folder: RunFolder, tree: dict[str, Any]) -> Player:
    return Player(folder.name, flatten(tree), _episodes(folder.artifact(EVALUATION)), folder.artifact(BEST_EPISODE))


def _evaluations(outputs: Path, skipped: dict[str, str]) -> tuple[dict[str, list[_Later]], list[Player]]:
    """The finished runs of the verb `evaluate` by the run that they evaluate, in the order they were made, and exported
    weights, at each epsilon by the latest of theirs."""
    found: dict[str, list[_Later]] = defaultdict(list)
    exported: dict[tuple[str, float], list[tuple[int, str, Player]]] = defaultdict(list)
    for path in sorted((outputs / "evaluations").glob(f"*/{RESULT}")):
        folder = RunFolder(path.parent)
        try:
            facts, commit = folder.config, folder.commit
            if commit is None:
                continue
            if not isfinite(epsilon := float(facts["evaluation"]["epsilon"])):
                raise ValueError("its epsilon is no number")
            if "run" in facts:
                found[str(facts["run"])].append(_Later(commit.updated, int(facts["step"]), epsilon, folder))
            elif "weights" in facts:
                player = _player(folder, facts)
                exported[str(facts["sha256"]), epsilon].append((commit.updated, folder.name, player))
        except (Fault, ValueError, KeyError, TypeError, OverflowError, OSError) as error:
            skipped[f"evaluations/{folder.name}"] = f"broken: {type(error).__name__}: {error}"
    trainings = {run: sorted(later, key=lambda each: each.made) for run, later in found.items()}
    return trainings, [max(made)[-1] for made in exported.values()]


def _episodes(path: Path, game: Game | None = None) -> EpisodeTable:
    """A table of episodes, and of its points those of a game's sources. Raises: ValueError, OSError."""
    episodes = EpisodeTable.read(path, game.sources if game else ())
    if not np.isfinite(episodes.scores).all():
        raise ValueError(f"{path} has a score that is no finite number")
    others = (episodes.steps, episodes.frames, episodes.truncated, episodes.counts)
    if not all(np.isfinite(each).all() for each in others):
        raise ValueError(f"{path} has a count that is no finite number")
    if game and game.actions and episodes.actions != game.actions:
        raise ValueError(f"{path} has other actions than the game")
    return episodes
