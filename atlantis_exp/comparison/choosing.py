"""Select runs by config and tags, group them, and refuse groups whose scores are not comparable."""

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any, TypeVar

from atlantis_exp.checking import nearest
from atlantis_exp.comparison.gather import Player, Run, Training
from atlantis_exp.components import title_of
from atlantis_exp.faults import ConfigError

R = TypeVar("R", bound=Run)

PROTOCOL = (
    *("env.id", "env.frameskip", "env.sticky", "env.max_frames", "env.max_steps", "env.noop_max", "env.max_pool"),
    *("env.crop", "evaluation.epsilon"),
)
"""The keys that must be equal for scores to be comparable; the observation's size belongs to the network."""

COMMIT = "git.commit"
"""The tag of a run's commit."""
_COMMIT_DIGITS = 10


def select(runs: Iterable[R], where: Sequence[str]) -> list[R]:
    """Return the runs that have every KEY=VALUE, with keys as in `group`. Raises: ConfigError."""
    runs = list(runs)
    for text in where:
        key, equals, _ = text.partition("=")
        if not equals:
            raise ConfigError(f"where={text}: write KEY=VALUE, as in where=model=cnn,seed=0")
        _check_key("where", key, runs)
    return [run for run in runs if is_where(run, where)]


def is_where(run: Run, where: Sequence[str]) -> bool:
    """Return whether a run has every KEY=VALUE."""
    facts = run.facts
    return all(_is(facts.get(resolve(key, facts)), value) for key, _, value in (text.partition("=") for text in where))


def group(runs: Iterable[R], by: Sequence[str]) -> dict[str, list[R]]:
    """Group runs by config keys or tags, with `model` short for `model.name`; sort the groups by label.

    Raises: ConfigError for a key that no run has.
    """
    runs = list(runs)
    for key in by:
        _check_key("by", key, runs)
    groups = defaultdict(list)
    for run in runs:
        groups[" ".join(values_in(run.facts, by)) or "all"].append(run)
    return dict(sorted(groups.items()))


def values_in(facts: Mapping[str, Any], by: Sequence[str]) -> tuple[str, ...]:
    """Return the values of keys as people write them; commits by their first digits."""
    values = []
    for key in by:
        name = resolve(key, facts)
        value = facts.get(name)
        text = value if isinstance(value, str) else f"{name.rsplit('.')[-1] or key}={json.dumps(value)}"
        values.append(text[:_COMMIT_DIGITS] if name == COMMIT else text)
    return tuple(values)


def resolve(key: str, config: Mapping[str, Any]) -> str:
    """Return the dotted key that a short one stands for, `model.name` for `model`; empty if there is none."""
    return next((name for name in (key, f"{key}.name", f"{key}.id") if name in config), "")


def shortened(keys: Iterable[str], facts: Mapping[str, Any]) -> tuple[str, ...]:
    """Return distinct keys in short form, in the order of their dotted forms."""
    short = []
    for key in sorted(keys, key=lambda key: resolve(key, facts)):
        stem = key.removesuffix(".name").removesuffix(".id")
        short.append(stem if resolve(stem, facts) == key else key)
    return tuple(dict.fromkeys(short))


def mixed_protocol(configs: Mapping[str, Mapping[str, Any]], by: Sequence[str]) -> tuple[str, str] | None:
    """Return the part of the protocol that differs, `game` or a key, and a sentence; None if scores are comparable.

    Keys of `by` may differ, except the game. `configs` has dotted keys by the name of a run or contender.
    """
    games = {name: title_of(config["env.id"]) for name, config in configs.items()}
    if len(set(games.values())) > 1:
        return "game", f"env.id differs: scores of different games are not compared: {holders(games)}"
    asked = {resolve(key, config) for key in by for config in configs.values()}
    for key in PROTOCOL:
        values = {name: json.dumps(config[key]) for name, config in configs.items()}
        if key not in asked and len(set(values.values())) > 1:
            return key, f"{key} differs, so the scores do not mean the same: {holders(values)}"
    return None


def refuse_mixed_protocols(trainings: Sequence[Training], by: Sequence[str]) -> None:
    """Raise ConfigError if trainings differ in a part of their protocol that is not in `by`."""
    if mixed := mixed_protocol({training.name: training.config for training in trainings}, by):
        key, sentence = mixed
        hint = {
            "game": "choose with runs= or where=env.id=ID",
            "evaluation.epsilon": (
                "at_epsilon=VALUE takes evaluations at that one, `evaluate run=NAME epsilon=VALUE` makes them"
            ),
        }.get(key, f"choose with runs= or where=, or ask for it with by={key}")
        raise ConfigError(f"{sentence}; {hint}")


def holders(values: Mapping[str, str]) -> str:
    """Return each value with its first name and the number of others."""
    names = defaultdict(list)
    for name, value in values.items():
        names[value].append(name)
    return "; ".join(
        f"{value} in {first}{f' and {len(others)} more' if others else ''}"
        for value, (first, *others) in sorted(names.items())
    )


def plays_alike(player: Player, trainings: Iterable[Training]) -> bool:
    """Return whether a player and all trainings play the same game; crop and epsilon belong to a network."""
    keys = {*PROTOCOL} - ({"env.crop"} if "weights" in player.config else {"env.crop", "evaluation.epsilon"})
    return all(player.config.get(key) == training.config[key] for training in trainings for key in keys)


def _check_key(option: str, key: str, runs: Sequence[Run]) -> None:
    if runs and not any(resolve(key, run.facts) for run in runs):
        raise ConfigError(f"{option}={key}: no such key; {nearest(key, {k for run in runs for k in run.facts})}")


def _is(value: Any, text: str) -> bool:
    """Return whether a text is a value as Python or JSON write it; a number may be in any form."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        with suppress(ValueError):
            return float(text) == value
    if isinstance(value, list):
        return "".join(text.split()) in (str(value).replace(" ", ""), json.dumps(value, separators=(",", ":")))
    return text in (str(value), json.dumps(value))
