"""Compose the config groups into a checked config with Hydra's compose API."""

import hashlib
import re
from dataclasses import MISSING, fields
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, cast

from hydra import initialize_config_dir
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from atlantis_exp import components
from atlantis_exp.checking import absolute, nearest, parse
from atlantis_exp.commands import CONF, default_outputs
from atlantis_exp.config import PINNED, record_plugins
from atlantis_exp.faults import ConfigError
from atlantis_exp.runs.files import ARTIFACT, read_file

T = TypeVar("T")

_LIKE = {"model": "cnn", "objective": "dqn", "env": "atlantis_standard"}
"""The options without settings from which plugins take the other keys of their kind."""


OmegaConf.register_new_resolver("outputs_folder", lambda: str(default_outputs()), replace=True)


def _head_for(objective: str, other: str = "plain") -> str:
    """Return the head that an objective needs, or else `other`."""
    component = components.known("objective").get(objective)
    return other if component is None or component.facts["head"] == "plain" else str(component.facts["head"])


OmegaConf.register_new_resolver("head_for", _head_for, replace=True)


def checked(schema: type[T], composed: DictConfig) -> T:
    """Return a composed config as an instance of its schema; admit its plugins. Raises: ConfigError."""
    admit_plugins(composed.get("plugins"))
    composition = OmegaConf.to_container(composed, resolve=True)
    assert isinstance(composition, dict)
    tree = {str(key): value for key, value in composition.items() if key != "plugins"}
    if "plugins" in {each.name for each in fields(cast(Any, schema))}:
        record_plugins(tree)
    training = tree.get("training")
    if isinstance(training, dict) and isinstance(training.get("weights"), str):
        training["weights"] = pinned(training["weights"])
    paths = tree.get("paths")
    if isinstance(paths, dict) and isinstance(text := paths.get("outputs"), str):
        paths["outputs"] = str(_folder("paths.outputs", text)) if text.strip() else ""
    return parse(schema, tree)


def _folder(key: str, text: str) -> Path:
    """Return the path of a folder, which may not exist yet. Raises: ConfigError."""
    folder = absolute(key, text)
    there = next(path for path in (folder, *folder.parents) if path.exists())
    if not there.is_dir() or folder == Path(folder.anchor):
        what = "the root of the file system" if there.is_dir() else f"{there} is not a folder"
        raise ConfigError(f"{key}={text}: {what}; name a folder of its own, as in {key}=./outputs")
    return folder


def pinned(weights: str) -> str:
    """Return a folder of exported weights as FOLDER@DIGEST. Raises: ConfigError, also if a typed digest is wrong."""
    folder, digits = weights.rpartition("@")[::2] if re.match(PINNED, weights) else (weights, "")
    path = absolute("training.weights", folder) / "weights.safetensors"
    try:
        found = hashlib.sha256(read_file(path.resolve(), ARTIFACT)).hexdigest()[:16]
    except (OSError, ValueError):
        others = [str(other.parent) for other in path.parent.parent.glob("*/weights.safetensors")]
        hint = nearest(folder, others)
        raise ConfigError(f"training.weights={folder}: not a folder of exported weights; {hint}") from None
    if digits not in ("", found):
        raise ConfigError(f"training.weights={weights}: its weights are @{found}")
    return f"{folder}@{found}"


def admit_plugins(plugins: Any) -> None:
    """Admit the plugins of the key `plugins`, and add their components to the groups. Raises: ConfigError."""
    components.admit([plugins] if isinstance(plugins, str) else plugins or [])
    for component in components.admitted().values():
        if (CONF / component.kind / f"{component.name}.yaml").is_file():
            raise ConfigError(
                f"{component.path}:{component.line}: {component.kind}={component.name} is a preset "
                "and cannot be replaced; rename yours"
            )
        ConfigStore.instance().store(name=component.name, group=component.kind, node=_option(component))


def _option(component: components.Component) -> dict[str, Any]:
    """Return a plugin component's config: its constructor's defaults, overridden by its YAML."""
    node: dict[str, Any] = {"defaults": [_LIKE[component.kind], "_self_"]} if component.kind in _LIKE else {}
    own = ("id", components.game_ids(component.name)[1]) if component.kind == "env" else ("name", component.name)
    node.update([own])
    if component.kind == "model":
        node["input_size"] = component.facts["input_size"]
    node |= {each.name: "???" if each.default is MISSING else each.default for each in component.settings}
    path = component.path.parent / "conf" / component.kind / f"{component.name}.yaml"
    if path.is_file():
        try:
            values = OmegaConf.to_container(OmegaConf.load(path))
        except (OSError, ValueError, RecursionError, YAMLError, OmegaConfBaseException) as error:
            raise ConfigError(f"{path}: {' '.join(str(error).split())}") from None
        if not isinstance(values, dict) or "defaults" in values:
            raise ConfigError(f"{path}: should hold one KEY: VALUE per line, and no defaults list")
        if values.setdefault(*own) != own[1]:
            raise ConfigError(f"{path}: {own[0]} should be {own[1]}, like the file's name")
        node |= {str(key): value for key, value in values.items()}
    return node


composing = partial(initialize_config_dir, str(CONF), version_base="1.3")
"""Returns a context in which Hydra composes from the config groups."""
