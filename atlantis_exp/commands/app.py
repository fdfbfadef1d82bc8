"""A verb as a Hydra app: overrides checked before anything is written, then Hydra's own main with all its flags."""

import argparse
import itertools
import os
import re
import shutil
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, TypeVar

import hydra
from hydra import compose, initialize_config_dir
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException, MissingConfigException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationKeyError, OmegaConfBaseException

from atlantis_exp.commands import VERBS
from atlantis_exp.config import ConfigError, flatten, nearest, parse
from atlantis_exp.faults import Fault

T = TypeVar("T")

_PACKAGE = Path(__file__).resolve().parents[1]
_CHECKOUT = _PACKAGE.parent
CONF = _PACKAGE / "conf" if (_PACKAGE / "conf").is_dir() else _CHECKOUT / "conf"
JOB_OF = "ATLANTIS_EXP_JOB_OF"
"""The environment variable that tells a process that it does one job of a sweep, apart from its launcher's worker."""


def _outputs_folder() -> str:
    # A checkout keeps its runs whatever the current folder is; an installed package has no place of its own.
    return str((_CHECKOUT if CONF.parent == _CHECKOUT else Path.cwd()) / "outputs")


def _help(config_name: str) -> str:
    verb = config_name if config_name in VERBS else "train"
    verbs = "\n".join(f"  {verb:15}{purpose}" for verb, purpose in VERBS.items())
    return f"python -m atlantis_exp {verb} KEY=VALUE ...\n{VERBS[verb]}\n\n== Verbs ==\n{verbs}\n"


# Our presets of Hydra's launchers bear the plugins' own names, so that these check their keys, which Hydra deplores.
warnings.filterwarnings("ignore", message=r"\n'hydra/launcher/\w+' is validated against ConfigStore schema")
OmegaConf.register_new_resolver("outputs_folder", _outputs_folder, replace=True)
OmegaConf.register_new_resolver("help", _help, replace=True)
# Of a Ray cluster that is started here, bytes, the least that Ray takes; a running cluster (a string) has its own.
OmegaConf.register_new_resolver("ray_object_store", lambda address: None if address else 78_643_200, replace=True)
# The head that an objective needs, unless a person asks for another.
OmegaConf.register_new_resolver(
    "head_for", lambda objective, other="plain": "quantile" if objective.endswith("quantile") else other, replace=True
)


class Launcher(NamedTuple):
    """What runs the jobs of a sweep: an option of `hydra/launcher`, or Hydra's own, which runs them here in turn."""

    name: str = "basic"
    n_jobs: int | None = None  # at a time, as joblib counts them
    ray: dict[str, Any] | None = None  # what `ray.init` takes

    @property
    def is_basic(self) -> bool:
        """Whether the jobs are done in the sweep's own process."""
        return self.name == "basic"


BASIC = Launcher()


def run_verb(
    config_name: str,
    schema: type[T],
    job: Callable[[T], None],
    sweep: Callable[[Sequence[T], Launcher], AbstractContextManager[None]] = lambda *_: nullcontext(),
) -> None:
    """Compose `conf/<config_name>.yaml` with the command line's overrides, check it, and call `job` with the result.

    A user's mistake ends the process with exit code 2 and one line on stderr before Hydra or the job starts; a `Fault`
    ends it with its own exit code and one line, and so does a folder that cannot be written. A sweep, and any job that
    is left to another process, runs inside of what `sweep` makes of all configs and the launcher.
    """
    try:
        configs = check(config_name, schema, sys.argv[1:])
        chosen = launcher(config_name, sys.argv[1:])
    except ConfigError as error:
        leave(error)

    @hydra.main(version_base="1.3", config_path=str(CONF), config_name=config_name)
    def main(composed: DictConfig) -> None:
        if job_of() is not None:
            sys.argv[1:] = HydraConfig.get().overrides.task  # what this job is, whoever started the process for what
        try:
            job(checked(schema, composed))
        except (ConfigError, Fault, OSError) as error:
            # In a sweep an exit would take the other jobs along, an exception does not.
            if HydraConfig.get().mode is RunMode.MULTIRUN:
                raise
            leave(error)

    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    try:
        with sweep(configs, chosen) if len(configs) > 1 or not chosen.is_basic else nullcontext():
            main()
    except (ConfigError, Fault, OSError) as error:
        leave(error)


def leave(error: Exception) -> NoReturn:
    """End the process with one line and the error's exit code: 2 for a user's mistake."""
    print(f"atlantis_exp: {error}", file=sys.stderr)
    sys.exit(2 if isinstance(error, ConfigError) else getattr(error, "exit_code", 1))


def checked(schema: type[T], composed: DictConfig) -> T:
    """A composed Hydra config as an instance of its schema class. Raises: ConfigError."""
    tree = OmegaConf.to_container(composed, resolve=True)
    assert isinstance(tree, dict)
    paths = tree.get("paths")
    if isinstance(paths, dict) and isinstance(paths.get("outputs"), str) and paths["outputs"]:
        paths["outputs"] = str(Path(paths["outputs"]).expanduser().absolute())
    return parse(schema, {str(key): value for key, value in tree.items()})


def check(config_name: str, schema: type[T], arguments: list[str]) -> list[T]:
    """Compose and check every job that a command line asks for; returns their configs, nothing is written.

    Raises:
        ConfigError: one line for the first mistake, with the nearest valid choice or the valid range.
    """
    texts, multirun = _read_flags(arguments)
    overrides = [read_override(text) for text in texts]
    for override in overrides:
        if override.is_sweep_override() and not multirun:
            raise ConfigError(f"{override.input_line}: several values are a sweep; add -m")
    hydras = [override for override in overrides if _is_hydras(override)]
    overrides = [override for override in overrides if not _is_hydras(override)]
    try:
        with composing():
            if hydras:
                _check_launcher(config_name, hydras)
            return [_check_job(config_name, schema, job) for job in _jobs(overrides)]
    except (HydraException, OmegaConfBaseException) as error:
        reason = f": {error.__cause__}" if isinstance(error.__cause__, OmegaConfBaseException) else ""
        raise ConfigError(" ".join(re.split("Config search path|full_key:", f"{error}{reason}")[0].split())) from None


@contextmanager
def composing() -> Iterator[None]:
    """Let `compose` compose from the config groups, inside of one of Hydra's jobs too."""
    under_way = GlobalHydra.instance().hydra  # of the job that asks; there can be only one at a time
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            yield
    finally:
        GlobalHydra.instance().hydra = under_way


def swept(arguments: list[str]) -> list[str]:
    """The overrides of a command line that name several values. Raises: ConfigError."""
    return [text for text in _read_flags(arguments)[0] if read_override(text).is_sweep_override()]


def launcher(config_name: str, arguments: list[str]) -> Launcher:
    """The launcher of a sweep that a command line asks for. Raises: ConfigError."""
    texts, multirun = _read_flags(arguments)
    hydras = [text for text in texts if _is_hydras(read_override(text))]
    if not multirun or not hydras:
        return BASIC
    with composing():
        settings = compose(config_name, hydras, return_hydra_config=True).hydra
    name, n_jobs = settings.runtime.choices["hydra/launcher"], OmegaConf.select(settings, "launcher.n_jobs")
    if (ray := OmegaConf.select(settings, "launcher.ray.init")) is None:
        return Launcher(name, n_jobs)
    return Launcher(name, n_jobs, {str(key): ray[key] for key in ray})


def job_of() -> str | None:
    """The launcher that this process does one job of a sweep for; None where that is Hydra's own, or there is none.

    It is `apart` for a job that a launcher's worker has left to a process of its own.
    """
    if JOB_OF in os.environ:
        return os.environ[JOB_OF]
    if not HydraConfig.initialized() or HydraConfig.get().mode is not RunMode.MULTIRUN:
        return None
    name = str(HydraConfig.get().runtime.choices["hydra/launcher"])
    return None if Launcher(name).is_basic else name


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
    keys = {f"hydra.launcher.{key}" for key in settings.launcher}
    for text, override in texts.items():
        key = ".".join(override.key_or_group.split(".")[:3])  # what is below, the user names
        if key.startswith("hydra.launcher.") and key not in keys:
            raise ConfigError(f"{text}: no such key; {nearest(key, keys)}")
    compose(config_name, list(texts), return_hydra_config=True)


def _read_flags(arguments: list[str]) -> tuple[list[str], bool]:
    """The overrides of a command line, and whether it is a sweep. Raises: ConfigError."""
    parser = get_args_parser()
    parser.exit_on_error = parser.allow_abbrev = False
    try:
        flags, unknown = parser.parse_known_args(arguments)
    except argparse.ArgumentError as error:
        raise ConfigError(" ".join(str(error).split())) from None
    if unknown:
        if not unknown[0].startswith("-"):
            raise ConfigError(f"{unknown[0]}: write all overrides together, before or after the flags")
        known = {option for action in parser._actions for option in action.option_strings}
        raise ConfigError(f"{unknown[0]}: no such flag; {nearest(unknown[0], known)}")
    for flag in ("config_path", "config_name", "config_dir", "experimental_rerun"):
        if getattr(flags, flag) is not None:
            raise ConfigError(f"--{flag.replace('_', '-')}: the verb decides on its config; write overrides instead")
    sweep = flags.multirun or "hydra.mode=MULTIRUN" in flags.overrides
    return flags.overrides, sweep


def read_override(text: str) -> Override:
    """An override as Hydra understands it. Raises: ConfigError."""
    if "=" not in text and not text.startswith("~"):
        raise ConfigError(f"'{text}' is no override; write KEY=VALUE, as in model=resnet")
    try:
        return OverridesParser.create().parse_override(text)
    except HydraException:
        raise ConfigError(
            f"{text}: not readable; write KEY=VALUE, a list as KEY=[1,2], other characters in quotes as KEY='\"a ü\"'"
        ) from None


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


def _check_job(config_name: str, schema: type[T], texts: list[str]) -> T:
    overrides = {text: read_override(text) for text in texts}
    groups = _groups(config_name)
    chosen = tuple(text for text, override in overrides.items() if _key(override) in groups)
    for text in chosen:
        override = overrides[text]
        folder, value = override.key_or_group, override.value()
        options = {path.stem for path in (CONF / folder).glob("*.yaml")}
        if override.is_delete():
            raise ConfigError(f"{text}: needed; choose with {folder}=OPTION (valid: {', '.join(sorted(options))})")
        if not isinstance(value, str) or value not in options:
            raise ConfigError(f"{folder}={value}: no such option in conf/{folder}; {nearest(str(value), options)}")
    keys = _keys(config_name, chosen)
    branches = {key.rsplit(".", depth)[0] for key in keys for depth in range(1, key.count(".") + 1)}
    for text, override in overrides.items():
        if text in chosen:
            continue
        key = _key(override)
        if key not in keys | branches:
            raise ConfigError(f"{text}: no such key; {_nearest_key(key, keys | branches | groups)}")
        if override.is_add() and key in keys:
            raise ConfigError(f"{text}: the key is there already; write {text.removeprefix('+')}")
        if override.is_delete() and not key.startswith("phase."):
            raise ConfigError(f"{text}: needed; change it with {key}=VALUE")
    try:
        return checked(schema, compose(config_name, texts))
    except InterpolationKeyError as error:
        missing = "".join(re.findall("'(.*)'", str(error)))
        raise ConfigError(f"${{{missing}}}: no such key; {_nearest_key(missing, keys)}") from None


@cache
def _keys(config_name: str, chosen: tuple[str, ...]) -> frozenset[str]:
    """The keys that options of groups give, which many jobs of a sweep share."""
    tree = OmegaConf.to_container(compose(config_name, list(chosen)))
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
    """The nearest key beside it, or of any depth; a bare name is also compared with the last parts, as `lr` with
    `optimizer.lr`."""
    parent = key.rpartition(".")[0]
    siblings = {known for known in keys if parent and known.rpartition(".")[0] == parent}
    exact = sorted(known for known in keys if known.rsplit(".", 1)[-1] == key.rsplit(".", 1)[-1])
    if exact and not siblings:
        return f"did you mean '{exact[0]}'?"
    return nearest(key, siblings or keys)
