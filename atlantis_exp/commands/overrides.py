"""Overrides as typed, checked before anything is composed for good: keys, options, sweeps, launchers."""

import argparse
import itertools
import math
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

from hydra import compose
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, RangeSweep
from hydra.errors import HydraException, MissingConfigException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationKeyError, OmegaConfBaseException
from yaml import YAMLError

from atlantis_exp.checking import absolute, flatten, nearest
from atlantis_exp.commands import CONF
from atlantis_exp.commands.composing import admit, checked, composing
from atlantis_exp.components import KINDS, admitted, installed
from atlantis_exp.faults import ConfigError
from atlantis_exp.sessions.job import quoted
from atlantis_exp.sessions.launchers import BASIC, Launcher

T = TypeVar("T")

_MOST_JOBS = 10_000  # of a sweep, and values of a key


def check(config_name: str, schema: type[T], arguments: Sequence[str]) -> dict[tuple[str, ...], T]:
    """Compose and check every job that a command line asks for: their configs by their overrides; writes nothing.

    Raises:
        ConfigError: one line for the first mistake, with the nearest valid choice or the valid range.
    """
    texts, multirun = read_flags(arguments)
    overrides = [read_override(text) for text in texts]
    for override in overrides:
        if override.is_sweep_override() and not multirun:
            raise ConfigError(f"{override.input_line}: several values are a sweep; add -m")
    hydras = [override for override in overrides if _is_hydras(override)]
    for override in hydras:
        _refuse_hydras(override)
        if is_run(arguments):
            raise ConfigError(f"{override.input_line}: is about the jobs of a sweep; add -m, or leave it out")
    overrides = [override for override in overrides if not _is_hydras(override)]
    admit(next((override.value() for override in overrides if override.key_or_group == "plugins"), []))
    own = config_dir(arguments)
    if own is not None:
        _check_config_dir(own)
    if own is not None or admitted():  # whose files may have changed
        _composed.cache_clear()
        _keys.cache_clear()
    try:
        with composing(own):
            if hydras:
                _check_launcher(config_name, hydras)
            jobs = {tuple(job): _check_job(config_name, schema, job, own) for job in _jobs(overrides)}
            if own is not None:
                _refuse_settings_of_hydra(config_name, own, texts, jobs)
            return jobs
    except (HydraException, OmegaConfBaseException) as error:
        reason = f": {error.__cause__}" if isinstance(error.__cause__, OmegaConfBaseException) else ""
        raise ConfigError(" ".join(re.split("Config search path|full_key:", f"{error}{reason}")[0].split())) from None
    except ConfigError:
        raise
    except (YAMLError, ValueError, TypeError, RecursionError) as error:  # of a file that Hydra and OmegaConf trusted
        if own is None:
            raise
        reason = " ".join(str(error).split())
        raise ConfigError(f"--config-dir={own}: {type(error).__name__}: {reason}") from None


def refuse_twice(arguments: Sequence[str]) -> None:
    """Refuse a key that a person gave two values, of which Hydra would take the last. Raises: ConfigError."""
    given: dict[str, str] = {}
    for text in read_flags(arguments)[0]:
        if (before := given.setdefault(key_of(text), text)) != text:
            raise ConfigError(f"{text}: {before} says something else; write one of the two")


def _refuse_hydras(override: Override) -> None:
    """Let pass what chooses a launcher and sets it up: anything else of Hydra's names code or places."""
    key = _key(override)
    if key == "hydra.mode":
        raise ConfigError(f"{override.input_line}: write -m for a sweep")
    is_choice = key == "hydra/launcher" and isinstance(override.value(), str)
    if override.is_delete() or not (is_choice or key.startswith("hydra.launcher.")):
        raise ConfigError(
            f"{override.input_line}: of Hydra's own, hydra/launcher=NAME and hydra.launcher.KEY=VALUE pass"
        )


def swept(arguments: Sequence[str]) -> list[str]:
    """The overrides of a command line that name several values. Raises: ConfigError."""
    return [text for text in read_flags(arguments)[0] if read_override(text).is_sweep_override()]


def launcher(config_name: str, arguments: Sequence[str]) -> Launcher:
    """The launcher of a sweep that a command line asks for. Raises: ConfigError."""
    texts, multirun = read_flags(arguments)
    hydras = [text for text in texts if _is_hydras(read_override(text))]
    if not multirun or not hydras:
        return BASIC
    with composing(config_dir(arguments)):
        settings = compose(config_name, hydras, return_hydra_config=True).hydra
    name, n_jobs = settings.runtime.choices["hydra/launcher"], OmegaConf.select(settings, "launcher.n_jobs")
    return Launcher(name, n_jobs)


def _check_launcher(config_name: str, overrides: list[Override]) -> None:
    """Check what the command line tells Hydra itself, above all of the launcher."""
    texts = {str(override.input_line): override for override in overrides}
    choices = [text for text, override in texts.items() if "/" in override.key_or_group]
    try:
        settings = compose(config_name, choices, return_hydra_config=True).hydra
        name, target = settings.runtime.choices["hydra/launcher"], settings.launcher._target_
        import_module(target.rpartition(".")[0])
    except ImportError:
        raise ConfigError(f"hydra/launcher={name}: needs pip install 'atlantis-exp[{name}]'") from None
    except MissingConfigException as error:  # the plugin's own, which the preset is made of
        if error.missing_cfg_file != "hydra/launcher/submitit_slurm":
            raise
        raise ConfigError("hydra/launcher=slurm: needs pip install 'atlantis-exp[slurm]'") from None
    if target.endswith(".SlurmLauncher") and shutil.which("srun") is None:
        raise ConfigError(f"hydra/launcher={name}: there is no srun here; submit from a machine of the cluster")
    keys = {f"hydra.launcher.{key}" for key in settings.launcher if key not in ("_target_", "submitit_folder")}
    for text, override in texts.items():
        key = ".".join(override.key_or_group.split(".")[:3])  # what is below, the user names
        if key.startswith("hydra.launcher.") and key not in keys:
            raise ConfigError(f"{text}: no such key; {nearest(key, keys)}")
    settings = compose(config_name, list(texts), return_hydra_config=True).hydra
    if OmegaConf.select(settings, "launcher.n_jobs") == 0:
        raise ConfigError("hydra.launcher.n_jobs=0: should be how many jobs at a time, or -1 for one a core")


def read_flags(arguments: Sequence[str]) -> tuple[list[str], bool]:
    """The overrides of a command line, and whether it is a sweep. Raises: ConfigError."""
    flags = _flags(arguments)
    return flags.overrides, flags.multirun


def is_run(arguments: Sequence[str]) -> bool:
    """Whether a command line asks for one job, not for a sweep or something to read. Raises: ConfigError."""
    flags = _flags(arguments)
    asked = ("multirun", "cfg", "info", "hydra_help", "shell_completion")
    return not any(getattr(flags, each) for each in asked)


def _flags(arguments: Sequence[str]) -> argparse.Namespace:
    parser = get_args_parser()
    parser.exit_on_error = parser.allow_abbrev = False
    try:
        flags, unknown = parser.parse_known_args(list(arguments))
    except argparse.ArgumentError as error:
        raise ConfigError(" ".join(str(error).split())) from None
    if unknown:
        if not unknown[0].startswith("-"):
            raise ConfigError(f"{unknown[0]}: write all overrides together, before or after the flags")
        known = {option for action in parser._actions for option in action.option_strings}
        raise ConfigError(f"{unknown[0]}: no such flag; {nearest(unknown[0], known)}")
    if flags.multirun and (shown := flags.cfg or flags.info):
        raise ConfigError(
            f"--{'cfg' if flags.cfg else 'info'} {shown}: shows one config; drop -m, and name one value a key"
        )
    for flag in ("resolve", "package"):
        if getattr(flags, flag) and not flags.cfg and not flags.info:
            raise ConfigError(f"--{flag}: is about what is printed instead of the work; add --cfg job")
    for flag in ("config_path", "config_name", "experimental_rerun"):
        if getattr(flags, flag) is not None:
            raise ConfigError(f"--{flag.replace('_', '-')}: the verb decides on its config; write overrides instead")
    return flags


def read_override(text: str) -> Override:
    """An override as Hydra understands it. Raises: ConfigError."""
    if "=" not in text and not text.startswith("~"):
        raise ConfigError(f"'{text}' is no override; write KEY=VALUE, as in model=resnet")
    try:
        return OverridesParser.create().parse_override(text)
    except ValueError:  # Python's own
        raise ConfigError(f"{text[:60]}...: a number of more than 4,300 digits") from None
    except RecursionError:
        raise ConfigError(f"{text[:60]}...: lists within lists, too deep to be read") from None
    except HydraException:
        raise ConfigError(
            f"{text}: not readable; write KEY=VALUE, a list as KEY=[1,2], other characters in quotes as KEY='\"a ü\"'"
        ) from None


def key_of(text: str) -> str:
    """What an override is about, as `sampler@samplers.uniform` of `++sampler@samplers.uniform=top_half`, however it is
    written. Raises: ConfigError."""
    return _key(read_override(text))


def _is_hydras(override: Override) -> bool:
    return re.match(r"hydra([./]|$)", override.key_or_group) is not None


def _jobs(overrides: list[Override]) -> Iterator[list[str]]:
    """The overrides of each job of a sweep (of the one job without a sweep)."""
    choices = []
    for override in overrides:
        if override.is_sweep_override():
            key = str(override.input_line).split("=", 1)[0]
            choices.append([f"{key}={value}" for value in values_of(override)])
        else:
            choices.append([str(override.input_line)])
    yield from map(list, combined(choices))


def combined(choices: Sequence[Sequence[str]]) -> Iterator[tuple[str, ...]]:
    """One of each with each of the others, the last one first to change. Raises: ConfigError for too many."""
    if (count := math.prod(map(len, choices))) > _MOST_JOBS:
        raise ConfigError(f"these values make {count:,} jobs, more than {_MOST_JOBS:,}: name fewer")
    return itertools.product(*choices)


def values_of(override: Override) -> list[str]:
    """The values that an override lists. Raises: ConfigError where there are none, or more than a sweep has jobs."""
    if isinstance(listed := override.value(), RangeSweep) and is_longer(listed, _MOST_JOBS):
        raise ConfigError(f"{override.input_line}: more than {_MOST_JOBS:,} values")
    try:
        values = [*override.sweep_string_iterator()]
    except ValueError as error:  # a range in steps of 0
        raise ConfigError(f"{override.input_line}: {error}") from None
    except HydraException:
        raise ConfigError(
            f"{override.input_line}: no list of values; write them out, or let `search` draw them"
        ) from None
    if not values:
        raise ConfigError(f"{override.input_line}: there is no value in it")
    return values


def is_longer(values: RangeSweep, most: int) -> bool:
    """Whether a range has more numbers; not where its step is 0, of which Python has a word to say."""
    assert values.start is not None
    assert values.stop is not None
    return values.step != 0 and abs(values.stop - values.start) > most * abs(values.step)


def _check_job(config_name: str, schema: type[T], texts: list[str], own: Path | None) -> T:
    overrides = {text: read_override(text) for text in texts}
    groups = _groups(config_name)
    chosen = tuple(text for text, override in overrides.items() if _key(override) in groups)
    for text in chosen:
        override = overrides[text]
        folder, value = override.key_or_group, override.value()
        places = (CONF, own) if own is not None else (CONF,)
        options = {path.stem for place in places for path in (place / folder).glob("*.yaml")}
        options |= {component.name for component in admitted().values() if component.kind == folder}
        if override.is_delete():
            raise ConfigError(f"{text}: needed; choose with {folder}=OPTION (valid: {', '.join(sorted(options))})")
        if not isinstance(value, str) or value not in options:
            hint = "; one of your own needs plugins=./FILE.py" if folder in KINDS and not admitted() else ""
            raise ConfigError(
                _offered(folder, str(value))
                or f"{folder}={value}: no such option in conf/{folder}; {nearest(str(value), options)}{hint}"
            )
    values = {text: override for text, override in overrides.items() if text not in chosen}
    try:
        if any(each.is_add() or each.is_force_add() or each.is_delete() for each in values.values()):
            _check_keys(values, _keys(config_name, chosen), groups)
        try:
            composed = _composed(config_name, tuple(texts))
        except (HydraException, ValueError) as error:  # mostly no such key; to know all takes as long as to compose
            for text in chosen:
                if overrides[text].is_add() and str(error).startswith(f"Multiple values for {_key(overrides[text])}."):
                    raise ConfigError(f"{text}: the config chooses one already; write {text[1:]}") from None
            _check_keys(values, _keys(config_name, chosen), groups)
            raise
        if OmegaConf.select(composed, "plugins") and "plugins" not in {_key(each) for each in overrides.values()}:
            raise ConfigError(f"--config-dir={own}: names plugins; only the command line may, as plugins=./FILE.py")
        return checked(schema, composed)
    except InterpolationKeyError as error:
        missing = "".join(re.findall("'(.*)'", str(error)))
        raise ConfigError(f"${{{missing}}}: no such key; {_nearest_key(missing, _keys(config_name, chosen))}") from None


def _check_keys(values: Mapping[str, Override], keys: frozenset[str], groups: set[str]) -> None:
    """Refuse overrides of keys that are not there, that are added though they are, and that are needed."""
    branches = {key.rsplit(".", depth)[0] for key in keys for depth in range(1, key.count(".") + 1)}
    for text, override in values.items():
        key = _key(override)
        if key not in keys | branches:
            raise ConfigError(f"{text}: no such key; {_nearest_key(key, keys | branches | groups)}")
        if override.is_add() and key in keys:
            raise ConfigError(f"{text}: the key is there already; write {text.removeprefix('+')}")
        if override.is_delete() and not key.startswith("phase."):
            raise ConfigError(f"{text}: needed; change it with {key}=VALUE")


def located(arguments: Sequence[str]) -> list[str]:
    """Arguments that mean the same in any folder: `--config-dir` and plugins as absolute paths. Raises: ConfigError.

    Plugins are one list however they were written, and `--config-dir` comes first.
    """
    arguments = [re.sub(r"^plugins=(.+)$", _located, argument, flags=re.DOTALL) for argument in arguments]
    if (folder := config_dir(arguments)) is None:
        return arguments
    arguments = [argument for argument in arguments if not re.match(r"(--config-dir|-cd)=", argument)]
    if (flag := next((at for at, text in enumerate(arguments) if text in ("--config-dir", "-cd")), None)) is not None:
        del arguments[flag : flag + 2]
    return [f"--config-dir={folder}", *arguments]


def config_dir(arguments: Sequence[str]) -> Path | None:
    """The folder of a person's own options that a command line names. Raises: ConfigError."""
    folder = _flags(arguments).config_dir
    return None if folder is None else absolute("--config-dir", folder)


def _check_config_dir(folder: Path) -> None:
    """Refuse a folder that is none, or that would be heard on more than the options of groups. Raises: ConfigError."""
    if not folder.is_dir():
        raise ConfigError(f"--config-dir={folder}: no such folder")
    if (folder / "hydra").exists():
        raise ConfigError(f"--config-dir={folder}: its group hydra/ would name code; only groups of ours are read")
    for group in sorted(path for path in CONF.iterdir() if path.is_dir()):
        ours = {path.name for path in group.glob("*.yaml")}
        if taken := sorted(path for path in (folder / group.name).glob("*.yaml") if path.name in ours):
            raise ConfigError(f"{taken[0]}: {group.name}={taken[0].stem} is ours and is not replaced; rename yours")


def _refuse_settings_of_hydra(
    config_name: str, folder: Path, typed: Sequence[str], jobs: Iterable[Sequence[str]]
) -> None:
    """Raise ConfigError where options of a person's own change what Hydra does, which is to run code."""
    hydras = [text for text in typed if _is_hydras(read_override(text))]
    plain = _hydras_own(config_name, hydras)
    # A sweep itself is composed, too, with the groups that have several options as they are without.
    for texts in (typed, *([*hydras, *job] for job in jobs)):
        if changed := sorted(key for key, value in _hydras_own(config_name, texts).items() if value != plain.get(key)):
            raise ConfigError(f"--config-dir={folder}: sets hydra.{changed[0]}, which may name code; drop it there")


def _hydras_own(config_name: str, texts: Sequence[str]) -> dict[str, Any]:
    """Hydra's settings without what follows from the overrides of ours in `texts` alone."""
    composer = GlobalHydra.instance().hydra
    assert composer is not None
    composed = composer.compose_config(config_name, list(texts), RunMode.MULTIRUN, validate_sweep_overrides=False)
    settings: Any = OmegaConf.to_container(composed.hydra, resolve=False)
    del settings["job"]["override_dirname"], settings["runtime"]["choices"]
    typed = [text for text in texts if not _is_hydras(read_override(text))]
    settings["overrides"]["task"] = settings["overrides"]["task"] != typed
    return {str(key): value for key, value in settings.items()}


def _located(match: re.Match[str]) -> str:
    references = []
    for text in match[1].removeprefix("[").removesuffix("]").split(","):
        reference = text.strip().strip("'\"")
        if "/" in reference or reference.endswith(".py"):
            reference = str(absolute("plugins", reference))
        references.append(quoted(reference))
    return f"plugins=[{','.join(references)}]"


def _offered(folder: str, name: str) -> str:
    """What to write for an option that an installed distribution offers; empty where none does."""
    offers = [f"plugins={plugin}" for plugin, names in installed().items() if folder in KINDS and name in names]
    return f"{folder}={name}: add {' or '.join(offers)}" if offers else ""


@cache
def _composed(config_name: str, texts: tuple[str, ...]) -> DictConfig:
    return compose(config_name, list(texts))


@cache
def _keys(config_name: str, chosen: tuple[str, ...]) -> frozenset[str]:
    """The keys that options of groups give, which many jobs of a sweep share."""
    tree = OmegaConf.to_container(_composed(config_name, chosen))
    assert isinstance(tree, dict)
    return frozenset(flatten({str(key): value for key, value in tree.items()}))


def _groups(config_name: str) -> set[str]:
    """The groups of a verb's defaults list, with the package that they fill: `model`, `sampler@samplers.uniform`."""
    config = OmegaConf.load(CONF / f"{config_name}.yaml")
    assert isinstance(config, DictConfig)
    groups: set[str] = set()
    for entry in config.get("defaults", ()):
        if isinstance(entry, DictConfig):
            groups |= {str(group) for group in entry}
        elif entry != "_self_":
            groups |= _groups(entry)
    return groups


def _key(override: Override) -> str:
    return override.key_or_group + (f"@{override.package}" if override.package else "")


def _nearest_key(key: str, keys: frozenset[str]) -> str:
    """The nearest key of the same parent, or of any depth; a bare name is compared with last parts, too, as `lr` with
    `optimizer.lr`."""
    parent = key.rpartition(".")[0]
    siblings = {known for known in keys if parent and known.rpartition(".")[0] == parent}
    exact = sorted(known for known in keys if known.rsplit(".", 1)[-1] == key.rsplit(".", 1)[-1])
    if exact and not siblings:
        return f"did you mean '{exact[0]}'?"
    return nearest(key, siblings or keys)
