"""Check a command line before anything is written: flags, keys, options, sweeps, launchers."""

import argparse
import itertools
import math
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from difflib import SequenceMatcher, get_close_matches
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from hydra import compose
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, IntervalSweep, Override, RangeSweep
from hydra.errors import HydraException
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import InterpolationKeyError, OmegaConfBaseException
from yaml import YAMLError

from atlantis_exp.checking import absolute, flatten, nearest
from atlantis_exp.commands import CONF
from atlantis_exp.commands.composing import admit_plugins, checked, composing
from atlantis_exp.commands.helping import groups_of, options_of
from atlantis_exp.components import KINDS, admitted, installed
from atlantis_exp.faults import ConfigError
from atlantis_exp.sessions.launchers import BASIC, Launcher
from atlantis_exp.terminal import quoted

T = TypeVar("T")

_PARSER = OverridesParser.create()
_MOST_JOBS = 10_000  # of a sweep, and values of a key
_LAUNCHERS = CONF / "hydra" / "launcher"


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise ConfigError(" ".join(message.split()))


_FLAGS = _Parser(add_help=False, allow_abbrev=False)
_FLAGS.add_argument("overrides", nargs="*")
_FLAGS.add_argument("--multirun", "-m", action="store_true")
_FLAGS.add_argument("--cfg", "-c", choices=["job"])
_FLAGS.add_argument("--resolve", action="store_true")
_FLAGS.add_argument("--config-dir", "-cd")


def flags_of(arguments: Sequence[str]) -> argparse.Namespace:
    """Return the overrides of a command line and its flags: multirun, cfg, resolve, config_dir. Raises: ConfigError."""
    flags, unknown = _FLAGS.parse_known_intermixed_args(list(arguments))
    if unknown:
        known = {option for action in _FLAGS._actions for option in action.option_strings}
        raise ConfigError(f"{unknown[0]}: no such flag; {nearest(unknown[0], known)}")
    if flags.multirun and flags.cfg:
        raise ConfigError("--cfg job: shows one config; drop -m, and write one value per key")
    if flags.resolve and not flags.cfg:
        raise ConfigError("--resolve: changes how a config is printed; add --cfg job")
    flags.config_dir = flags.config_dir and absolute("--config-dir", flags.config_dir)
    flags.overrides = [text.lstrip("+") for text in flags.overrides]  # every key exists
    return flags


def located(arguments: Sequence[str]) -> list[str]:
    """Make paths in arguments absolute. Raises: ConfigError."""
    flags = flags_of(arguments)
    return [
        *([f"--config-dir={flags.config_dir}"] if flags.config_dir else []),
        *(["-m"] if flags.multirun else []),
        *(["--cfg", flags.cfg] if flags.cfg else []),
        *(["--resolve"] if flags.resolve else []),
        *(re.sub(r"^plugins=(?!null$)(.+)$", _located, text, flags=re.DOTALL) for text in flags.overrides),
    ]


_ITEM = re.compile(r"""(?:"(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*'|[^,])+""")
"""Of a list whose quoted items may hold commas."""


def _located(match: re.Match[str]) -> str:
    """Return plugins as one list, however they were written."""
    references = []
    for text in _ITEM.findall(match[1].removeprefix("[").removesuffix("]")):
        reference = text.strip()
        if re.fullmatch(r"(['\"]).*\1", reference, re.DOTALL):
            reference = str(read_override(f"plugins={reference}").value())
        if "/" in reference or reference.endswith(".py"):
            reference = str(absolute("plugins", reference))
        references.append(quoted(reference))
    return f"plugins=[{','.join(references)}]"


def refuse_twice(arguments: Sequence[str]) -> None:
    """Raise ConfigError for a key with two values: Hydra would take the last."""
    given: dict[str, str] = {}
    for text in flags_of(arguments).overrides:
        if (before := given.setdefault(key_of(text), text)) != text:
            raise ConfigError(f"{text}: contradicts {before}; drop one of them")


def check(config_name: str, schema: type[T], arguments: Sequence[str]) -> dict[tuple[str, ...], T]:
    """Compose and check every job of a command line; return their configs by their overrides and --config-dir.

    Raises: ConfigError, one line for the first mistake with the nearest valid choice or the valid range.
    """
    flags = flags_of(arguments)
    overrides = [read_override(text) for text in flags.overrides]
    for override in overrides:
        if override.is_sweep_override() and not flags.multirun:
            raise ConfigError(f"{override.input_line}: several values are a sweep; add -m")
        if override.is_delete() and not _key(override).startswith(("phase.", "hydra")):
            raise ConfigError(f"{override.input_line}: the key is required; write {_key(override)}=VALUE")
    launcher(arguments)
    overrides = [override for override in overrides if not _is_hydras(override)]
    admit_plugins(next((override.value() for override in overrides if override.key_or_group == "plugins"), []))
    own: Path | None = flags.config_dir
    if own is not None:
        _check_config_dir(own)
    if own is not None or admitted():  # whose files may have changed
        _chosen.cache_clear()
    try:
        with composing():
            configs = {job: _check_job(config_name, schema, job, own) for job in jobs_of(overrides)}
        return {((f"--config-dir={own}", *job) if own else job): config for job, config in configs.items()}
    except (HydraException, OmegaConfBaseException) as error:
        reason = f": {error.__cause__}" if isinstance(error.__cause__, OmegaConfBaseException) else ""
        text = " ".join(re.split("Config search path|full_key:", f"{error}{reason}")[0].split())
        key = getattr(error, "full_key", None)  # of a value that refers to another
        raise ConfigError(f"{key}: {text}" if key and key not in text else text) from None
    except (YAMLError, ValueError, TypeError, RecursionError) as error:  # Hydra and OmegaConf do not check their files
        if own is None or isinstance(error, ConfigError):
            raise
        reason = " ".join(str(error).split())
        raise ConfigError(f"--config-dir={own}: {type(error).__name__}: {reason}") from None


def shown(config_name: str, arguments: Sequence[str]) -> str:
    """Return the composed config of a checked command line as YAML."""
    flags = flags_of(arguments)
    with composing():
        composed = _composed(config_name, [read_override(text) for text in flags.overrides], flags.config_dir)
        return OmegaConf.to_yaml(composed, resolve=flags.resolve)


def swept(arguments: Sequence[str]) -> list[str]:
    """Return the overrides of a command line that name several values. Raises: ConfigError."""
    return [text for text in flags_of(arguments).overrides if read_override(text).is_sweep_override()]


def launcher(arguments: Sequence[str]) -> Launcher:
    """Return the launcher of `hydra/launcher=NAME` and `hydra.launcher.KEY=VALUE`. Raises: ConfigError."""
    flags = flags_of(arguments)
    overrides = [override for text in flags.overrides if _is_hydras(override := read_override(text))]
    name = "basic"
    for override in overrides:
        text, key = override.input_line, _key(override)
        is_choice = key == "hydra/launcher" and isinstance(override.value(), str)
        if key == "hydra.mode":
            raise ConfigError(f"{text}: write -m for a sweep")
        if override.is_delete() or not (is_choice or key.startswith("hydra.launcher.")):
            raise ConfigError(f"{text}: of Hydra's keys, set only hydra/launcher=NAME and hydra.launcher.KEY=VALUE")
        if not flags.multirun:
            raise ConfigError(f"{text}: applies to a sweep of trainings; add -m or drop it")
        if is_choice:
            name = str(override.value())
    names = ["basic", *(path.stem for path in _LAUNCHERS.glob("*.yaml"))]
    if name not in names:
        raise ConfigError(f"hydra/launcher={name}: no such launcher; {nearest(name, names)}")
    if name == "slurm" and find_spec("submitit") is None:
        raise ConfigError("hydra/launcher=slurm: needs pip install 'atlantis-exp[slurm]'")
    if name == "slurm" and shutil.which("srun") is None:
        raise ConfigError("hydra/launcher=slurm: srun is not installed; submit from a node of the cluster")
    settings = DictConfig({}) if name == "basic" else OmegaConf.load(_LAUNCHERS / f"{name}.yaml")
    assert isinstance(settings, DictConfig)
    for override in overrides:
        if "/" not in override.key_or_group:
            if name == "basic":
                raise ConfigError(f"{override.input_line}: sets up a launcher; add hydra/launcher=joblib or slurm")
            _set_up(settings, override)
    if name == "basic":
        return BASIC
    if settings.get("n_jobs") == 0:
        raise ConfigError("hydra.launcher.n_jobs=0: write the number of jobs at a time, or -1 for one per core")
    return Launcher(name, OmegaConf.to_container(settings))  # type: ignore[arg-type]


_KINDS = {int: "an integer", bool: "true or false", str: "text", DictConfig: "a mapping", ListConfig: "a list"}


def _set_up(settings: DictConfig, override: Override) -> None:
    """Change one setting of a launcher; keys below it are not checked."""
    key, value = override.key_or_group.removeprefix("hydra.launcher."), override.value()
    first, _, below = key.partition(".")
    if first not in settings:
        known = [f"hydra.launcher.{each!s}" for each in settings]
        raise ConfigError(f"{override.input_line}: no such key; {nearest(f'hydra.launcher.{first}', known)}")
    before = settings[first]
    kind = DictConfig if below else type(OmegaConf.create({"value": value}).value)
    if before is not None and type(before) is not kind:
        raise ConfigError(f"{override.input_line}: should be {_KINDS[type(before)]}, as {before}")
    OmegaConf.update(settings, key, value, force_add=bool(below))


def read_override(text: str) -> Override:
    """Parse an override as Hydra does. Raises: ConfigError."""
    if "=" not in text and not text.startswith("~"):
        raise ConfigError(f"'{text}' is not an override; write KEY=VALUE, as in model=resnet")
    try:
        return _PARSER.parse_override(text)
    except ValueError:  # Python's limit
        raise ConfigError(f"{text[:60]}...: a number of more than 4,300 digits") from None
    except RecursionError:
        raise ConfigError(f"{text[:60]}...: lists nested too deeply") from None
    except HydraException:
        raise ConfigError(
            f"{text}: not readable; write KEY=VALUE, a list as KEY=[1,2], other characters in quotes as KEY='\"a ü\"'"
        ) from None


def key_of(text: str) -> str:
    """Return the key of an override, without its prefix: `sampler@samplers.uniform`. Raises: ConfigError."""
    return _key(read_override(text))


def _is_hydras(override: Override) -> bool:
    return re.match(r"hydra([./]|$)", override.key_or_group) is not None


def jobs_of(overrides: Sequence[Override]) -> Iterator[tuple[str, ...]]:
    """Return the overrides of each job. Raises: ConfigError for too many."""
    choices = []
    for override in overrides:
        key = str(override.input_line).split("=", 1)[0]
        is_sweep = override.is_sweep_override()
        choices.append([f"{key}={each}" for each in values_of(override)] if is_sweep else [str(override.input_line)])
    if (count := math.prod(map(len, choices))) > _MOST_JOBS:
        raise ConfigError(f"these values make {count:,} jobs; write values for at most {_MOST_JOBS:,}")
    return itertools.product(*choices)


def values_of(override: Override) -> list[str]:
    """Return the values that an override lists, of a glob our options. Raises: ConfigError for none or too many."""
    if isinstance(listed := override.value(), RangeSweep) and is_longer(listed, _MOST_JOBS):
        raise ConfigError(f"{override.input_line}: more than {_MOST_JOBS:,} values")
    try:
        values = [*override.sweep_string_iterator()]
    except ValueError as error:  # a range in steps of 0
        reason = str(error).partition("\n")[0]
        raise ConfigError(f"{override.input_line}: {reason}") from None
    except HydraException:
        values = listed.filter(options_of(override.key_or_group)) if isinstance(listed, Glob) else []
        if not values:
            reason = "not a list of values; write them out, or let `search` draw them"
            raise ConfigError(f"{override.input_line}: {reason}") from None
    if not values:
        raise ConfigError(f"{override.input_line}: has no values")
    return values


def with_first_values(arguments: Sequence[str]) -> list[str]:
    """Return arguments with only the first value of each key. Raises: ConfigError for a key without values."""
    several = swept(arguments)

    def first(text: str) -> object:
        override = read_override(text)
        value = override.value()
        if isinstance(value, IntervalSweep) or (isinstance(value, RangeSweep) and is_longer(value, _MOST_JOBS)):
            return value.start
        return values_of(override)[0]

    return [f"{text.split('=', 1)[0]}={first(text)}" if text in several else text for text in arguments]


def is_longer(values: RangeSweep, most: int) -> bool:
    """Tell whether a range has more numbers than `most`; False for step 0, which fails later."""
    assert values.start is not None
    assert values.stop is not None
    return values.step != 0 and not abs(values.stop - values.start) <= most * abs(values.step)  # NaN counts as long


def _check_job(config_name: str, schema: type[T], texts: Sequence[str], own: Path | None) -> T:
    parsed, groups = [read_override(text) for text in texts], _groups(config_name)
    overrides = dict(zip(texts, parsed, strict=True))
    chosen = tuple(text for text, override in overrides.items() if _key(override) in groups)
    for text in chosen:
        folder, value = overrides[text].key_or_group, overrides[text].value()
        options = {path.stem for place in filter(None, (CONF, own)) for path in (place / folder).glob("*.yaml")}
        options |= {component.name for component in admitted().values() if component.kind == folder}
        if not isinstance(value, str) or value not in options:
            hint = "; one of your own needs plugins=./FILE.py" if folder in KINDS and not admitted() else ""
            raise ConfigError(
                _offered(folder, str(value))
                or f"{folder}={value}: no such option in conf/{folder}; {nearest(str(value), options)}{hint}"
            )
    values = {text: override for text, override in overrides.items() if text not in chosen}
    try:
        try:
            composed = _composed(config_name, parsed, own)
        except (HydraException, ValueError):  # most often an unknown key, which `_check_keys` explains better
            _check_keys(values, _keys(config_name, chosen, own), groups)
            raise
        if OmegaConf.select(composed, "plugins") and "plugins" not in {_key(each) for each in overrides.values()}:
            raise ConfigError(f"--config-dir={own}: names plugins; name them on the command line, as plugins=./FILE.py")
        return checked(schema, composed)
    except InterpolationKeyError as error:
        missing = "".join(re.findall("'(.*)'", str(error)))
        hint = _nearest_key(missing, _keys(config_name, chosen, own))
        raise ConfigError(f"${{{missing}}}: no such key; {hint}") from None


def _check_keys(values: Mapping[str, Override], keys: frozenset[str], groups: frozenset[str]) -> None:
    """Raise ConfigError for an override of an unknown key."""
    branches = {key.rsplit(".", depth)[0] for key in keys for depth in range(1, key.count(".") + 1)}
    for text, override in values.items():
        key = _key(override)
        if key not in keys | branches:
            raise ConfigError(f"{text}: no such key; {_nearest_key(key, keys | branches | groups)}")


def _check_config_dir(folder: Path) -> None:
    """Raise ConfigError for a folder that is missing, or would change more than add options to groups."""
    if not folder.is_dir():
        raise ConfigError(f"--config-dir={folder}: no such folder")
    if (folder / "hydra").exists():
        raise ConfigError(f"--config-dir={folder}: its group hydra/ could name code; remove it")
    for group in sorted(path for path in CONF.iterdir() if path.is_dir()):
        ours = {path.name for path in group.glob("*.yaml")}
        if taken := sorted(path for path in (folder / group.name).glob("*.yaml") if path.name in ours):
            raise ConfigError(f"{taken[0]}: {group.name}={taken[0].stem} is built in; rename yours")


def _offered(folder: str, name: str) -> str:
    """Return the advice for an option that an installed distribution offers, or an empty text."""
    offers = [f"plugins={plugin}" for plugin, names in installed().items() if folder in KINDS and name in names]
    return f"{folder}={name}: add {' or '.join(offers)}" if offers else ""


def _composed(config_name: str, overrides: Sequence[Override], own: Path | None) -> DictConfig:
    """Compose a config as Hydra does; jobs of a sweep share the slow part."""
    groups = _groups(config_name)
    choices = tuple(str(each.input_line) for each in overrides if _key(each) in groups)
    config = deepcopy(_chosen(config_name, choices, own))
    ConfigLoaderImpl._apply_overrides_to_config([each for each in overrides if _key(each) not in groups], config)
    return config


@cache
def _chosen(config_name: str, choices: tuple[str, ...], own: Path | None) -> DictConfig:
    """Compose the chosen options of groups; `own` is a folder of further options, searched after ours."""
    return compose(config_name, [*choices, *([f"hydra.searchpath=[{quoted(f'file://{own}')}]"] if own else [])])


def _keys(config_name: str, choices: tuple[str, ...], own: Path | None) -> frozenset[str]:
    """Return the keys of the chosen options of groups."""
    tree: Any = OmegaConf.to_container(_chosen(config_name, choices, own))
    return frozenset(flatten(tree))


@cache
def _groups(config_name: str) -> frozenset[str]:
    """Return the groups of a verb's defaults list, with the package that they fill: `sampler@samplers.uniform`."""
    return frozenset(dict(groups_of(CONF / f"{config_name}.yaml")))


def _key(override: Override) -> str:
    return override.key_or_group + (f"@{override.package}" if override.package else "")


def _nearest_key(key: str, keys: frozenset[str]) -> str:
    """Suggest the nearest key of the same parent, or else of any: for `gama` and `gamma` `objective.gamma`."""
    parent = key.rpartition(".")[0]
    siblings = {known for known in keys if parent and known.rpartition(".")[0] == parent}
    alike = {known: SequenceMatcher(None, key, known).ratio() for known in keys}
    ends = {known.rsplit(".", 1)[-1]: known for known in sorted(keys, key=alike.__getitem__)}  # the last, most alike
    cutoff = 0.7 if max(alike.values()) < 0.5 else 1.0
    if not siblings and (close := get_close_matches(key.rsplit(".", 1)[-1], ends, n=1, cutoff=cutoff)):
        return f"did you mean '{ends[close[0]]}'?"
    return nearest(key, siblings or keys)
