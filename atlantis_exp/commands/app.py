"""A verb as a Hydra app: overrides checked before anything is written, then Hydra's own main with all its flags."""

import itertools
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import hydra
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from atlantis_exp.config import ConfigError, flatten, nearest, parse
from atlantis_exp.faults import Fault

T = TypeVar("T")

_PACKAGE = Path(__file__).resolve().parents[1]
_CHECKOUT = _PACKAGE.parent
CONF = _PACKAGE / "conf" if (_PACKAGE / "conf").is_dir() else _CHECKOUT / "conf"
_FLAGS_WITH_VALUE = (
    "--cfg",
    "-c",
    "--package",
    "-p",
    "--config-path",
    "-cp",
    "--config-name",
    "-cn",
    "--config-dir",
    "-cd",
)


def _outputs_folder() -> str:
    # A checkout keeps its runs whatever the current folder is; an installed package has no place of its own.
    return str((_CHECKOUT if CONF.parent == _CHECKOUT else Path.cwd()) / "outputs")


OmegaConf.register_new_resolver("outputs_folder", _outputs_folder, replace=True)


def run_verb(config_name: str, schema: type[T], job: Callable[[T], None]) -> None:
    """Compose `conf/<config_name>.yaml` with the command line's overrides, check it, and call `job` with the result.

    A user's mistake ends the process with exit code 2 and one line on stderr before Hydra or the job starts; a `Fault`
    ends it with its own exit code and one line.
    """
    try:
        _check(config_name, schema, sys.argv[1:])
    except (ConfigError, HydraException, OmegaConfBaseException) as error:
        print(f"atlantis_exp: {str(error).strip().splitlines()[0]}", file=sys.stderr)
        sys.exit(2)

    @hydra.main(version_base="1.3", config_path=str(CONF), config_name=config_name)
    def main(composed: DictConfig) -> None:
        try:
            job(checked(schema, composed))
        except (ConfigError, Fault) as error:
            # In a sweep an exit would take the other jobs along, an exception does not.
            if HydraConfig.get().mode is RunMode.MULTIRUN:
                raise
            print(f"atlantis_exp: {error}", file=sys.stderr)
            sys.exit(error.exit_code if isinstance(error, Fault) else 2)

    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    try:
        main()
    except Fault as error:
        print(f"atlantis_exp: {error}", file=sys.stderr)
        sys.exit(error.exit_code)


def checked(schema: type[T], composed: DictConfig) -> T:
    """A composed Hydra config as an instance of its schema class."""
    tree = OmegaConf.to_container(composed, resolve=True)
    assert isinstance(tree, dict)
    paths = tree.get("paths")
    if isinstance(paths, dict) and isinstance(paths.get("outputs"), str):
        paths["outputs"] = str(Path(paths["outputs"]).expanduser().absolute())
    return parse(schema, {str(key): value for key, value in tree.items()})


def _check(config_name: str, schema: type[T], arguments: list[str]) -> None:
    """Compose and check every job that the arguments ask for. Raises: ConfigError."""
    texts, skip = [], False
    for argument in arguments:
        if not argument.startswith("-") and not skip:
            texts.append(argument)
        skip = argument in _FLAGS_WITH_VALUE
    for text in texts:
        if "=" not in text and not text.startswith("~"):
            raise ConfigError(f"'{text}' is no override; write KEY=VALUE, as in model=resnet")
    overrides = [override for override in OverridesParser.create().parse_overrides(texts) if not _is_hydras(override)]
    multirun = bool({"-m", "--multirun"} & set(arguments)) or any(text.startswith("hydra.mode=") for text in texts)
    for override in overrides:
        if override.is_sweep_override() and not multirun:
            raise ConfigError(f"{override.input_line}: several values are a sweep; add -m")
    with initialize_config_dir(str(CONF), version_base="1.3"):
        for job in _jobs(overrides):
            _check_job(config_name, schema, job)


def _is_hydras(override: Override) -> bool:
    return override.key_or_group.startswith(("hydra.", "hydra/"))


def _jobs(overrides: list[Override]) -> Iterator[list[str]]:
    """The overrides of each job of a sweep (of the one job without a sweep)."""
    choices = []
    for override in overrides:
        if override.is_sweep_override():
            key = str(override.input_line).split("=", 1)[0]
            choices.append([f"{key}={value}" for value in override.sweep_string_iterator()])
        else:
            choices.append([str(override.input_line)])
    for combination in itertools.product(*choices):
        yield list(combination)


def _check_job(config_name: str, schema: type[T], texts: list[str]) -> None:
    overrides = OverridesParser.create().parse_overrides(texts)
    groups = {str(path.relative_to(CONF)): path for path in CONF.iterdir() if path.is_dir()}
    for override in overrides:
        group = override.key_or_group.split("@")[0]
        if group in groups and not override.is_delete():
            options = {path.stem for path in groups[group].glob("*.yaml")}
            value = override.value()
            if not isinstance(value, str) or value not in options:
                raise ConfigError(f"{group}={value}: no such option in conf/{group}; {nearest(str(value), options)}")
    chosen = [text for override, text in zip(overrides, texts, strict=True) if _names_group(override, groups)]
    known = OmegaConf.to_container(compose(config_name, chosen))
    assert isinstance(known, dict)
    keys = {str(key): value for key, value in flatten({str(key): value for key, value in known.items()}).items()}
    branches = {key.rsplit(".", depth)[0] for key in keys for depth in range(1, key.count(".") + 1)}
    for override in overrides:
        key = override.key_or_group.split("@")[0]
        if not _names_group(override, groups) and key not in keys and key not in branches:
            raise ConfigError(f"{override.input_line}: no such key; {_nearest_key(key, {*keys, *branches, *groups})}")
    checked(schema, compose(config_name, texts))


def _names_group(override: Override, groups: dict[str, Path]) -> bool:
    return override.key_or_group.split("@")[0] in groups


def _nearest_key(key: str, keys: set[str]) -> str:
    """The nearest key of any depth; a bare name is also compared with the last parts, as `lr` with `optimizer.lr`."""
    exact = sorted(known for known in keys if known.rsplit(".", 1)[-1] == key.rsplit(".", 1)[-1])
    if exact:
        return f"did you mean '{exact[0]}'?"
    parent = key.rpartition(".")[0]
    siblings = {known for known in keys if known.rpartition(".")[0] == parent}
    return nearest(key, siblings if siblings and parent else keys)


def conf_names() -> dict[str, Any]:
    """Group names and their options, for tests that compose every preset."""
    return {path.name: sorted(file.stem for file in path.glob("*.yaml")) for path in CONF.iterdir() if path.is_dir()}
