"""What a run is called where people read it: what differs from the defaults, and nothing else."""

import json
from functools import cache
from pathlib import Path
from typing import Any

from hydra import compose
from omegaconf import OmegaConf

from atlantis_exp.commands.app import CONF, checked, composing
from atlantis_exp.config import BaselineConfig, Config, digest, flatten, to_dict
from atlantis_exp.media import run_colour

_NAMED = ("model", "sampler", "objective", "optimizer", "epsilon")  # groups whose options carry their names
_SPELLED = 4  # differences at most; beyond them a few digits of their hash tell runs apart


def title(config: Config) -> str:
    """The network, the samplers, the seed, then what else is not as in the nearest preset: `resnet top_half s1`.

    Configs of one identity have one title, and different ones differ in it.
    """
    player, rest = _words(config)
    return " ".join([*player, f"s{config.seed}", *rest])


def group(config: Config) -> str:
    """The title that runs which differ only in their seed have in common."""
    player, rest = _words(config)
    return " ".join([*player, *rest])


def _words(config: Config) -> tuple[list[str], list[str]]:
    """What is said before the seed, and after it."""
    player = [config.model.name, *dict.fromkeys(phase.sampler for phase in config.phase.values())]
    words = [getattr(config, group).name for group in _NAMED[2:] if getattr(config, group).name != _defaults()[group]]
    env = _nearest_env(config)
    words += [env] if env != _defaults()["env"] else []
    named = {group: getattr(config, group).name for group in _NAMED}
    choices = (f"env={env}", *(f"{group}={option}" for group, option in named.items()))
    leaves = _leaves(config)
    # No preset goes before any that is as near, and a later rung before the earlier one that has its options here.
    preset, differing = min(
        ((name, _differing(leaves, _preset(name, choices))) for name in reversed(_presets(**named))),
        key=lambda candidate: (len(candidate[1]), candidate[0] != "none"),
    )
    words += [preset] if preset != "none" else []
    if len(differing) > _SPELLED:
        return player, [*words, digest(leaves)[:6]]
    return player, [*words, *differing]


def colour(config: Config) -> str:
    """The colour of all runs with this network and, in the end, this sampler."""
    return run_colour(config.model.name, list(config.phase.values())[-1].sampler)


def labels(title: str, colour: str) -> dict[str, str]:
    """The tags by which MLflow shows a run so."""
    return {"mlflow.runName": title, "mlflow.runColor": colour}


def baseline_title(config: BaselineConfig) -> str:
    """The player, its game, and a few digits of its identity."""
    action = f" {config.agent.action}" if config.agent.name == "constant" else ""
    return f"{config.agent.name}{action} {config.env.id.rsplit('/')[-1]} {config.identity()[:6]}"


def _differing(leaves: dict[str, str], preset: dict[str, str]) -> list[str]:
    """Each difference as `key=value`, the key as short as it is clear: `lr` where every lr has this value."""
    values: dict[str, set[str]] = {}
    for key, value in leaves.items():
        values.setdefault(key.rsplit(".", 1)[-1], set()).add(value)
    short = {key: last if len(values[last := key.rsplit(".", 1)[-1]]) == 1 else key for key in leaves}
    changed = [f"{short[key]}={value}" for key, value in leaves.items() if preset.get(key) != value]
    return list(dict.fromkeys(changed)) + [f"{key}=none" for key in preset if key not in leaves]


def _leaves(config: Config) -> dict[str, str]:
    science = config.science()
    del science["seed"]
    science["phase"] = {str(index): phase for index, phase in enumerate(science["phase"])}
    return {key: value if isinstance(value, str) else json.dumps(value) for key, value in flatten(science).items()}


def _nearest_env(config: Config) -> str:
    """The option of the group `env` that most of the values are from."""
    env = to_dict(config.env)

    def agreeing(option: str) -> int:
        return sum(env[key] == value for key, value in _plain(CONF / "env" / f"{option}.yaml").items())

    options = sorted(path.stem for path in (CONF / "env").glob("*.yaml"))
    return max((_defaults()["env"], *options), key=agreeing)


@cache
def _presets(**named: str) -> tuple[str, ...]:
    """`none`, then the presets that may be near a config with these options of the named groups.

    Not those for another network, nor, of those that build on others, any with another option than the config's: they
    are many, and a step in a direction that the config has not taken.
    """
    near = ["none"]
    for path in sorted((CONF / "experiment").glob("*.yaml")):
        choices = _choices(path)
        groups = _NAMED if _bases(path) else ("model",)
        if path.stem != "none" and all(choices.get(f"override /{key}", named[key]) == named[key] for key in groups):
            near.append(path.stem)
    return tuple(near)


@cache
def _preset(name: str, choices: tuple[str, ...]) -> dict[str, str]:
    with composing():
        return _leaves(checked(Config, compose("config", [f"experiment={name}", *choices])))


@cache
def _defaults() -> dict[str, str]:
    """The option of each group that is taken unless another is asked for."""
    return _choices(CONF / "config.yaml")


def _choices(path: Path) -> dict[str, str]:
    """The options that a config file, or one that it builds on, takes of groups."""
    choices: dict[str, str] = {}
    for base in _bases(path):
        choices |= _choices(base)
    for entry in _plain(path).get("defaults", []):
        choices |= entry if isinstance(entry, dict) else {}
    return choices


def _bases(path: Path) -> list[Path]:
    """The files that a config file builds on."""
    entries = _plain(path).get("defaults", [])
    return [path.with_name(f"{entry}.yaml") for entry in entries if isinstance(entry, str) and entry != "_self_"]


@cache
def _plain(path: Path) -> dict[str, Any]:
    tree = OmegaConf.to_container(OmegaConf.load(path), resolve=False)
    assert isinstance(tree, dict)
    return {str(key): value for key, value in tree.items()}
