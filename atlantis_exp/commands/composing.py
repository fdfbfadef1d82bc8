"""The config groups composed into a checked config; Hydra's compose API and OmegaConf are here and in `app` alone."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf

from atlantis_exp.checking import parse
from atlantis_exp.commands import VERBS

T = TypeVar("T")

_PACKAGE = Path(__file__).resolve().parents[1]
_CHECKOUT = _PACKAGE.parent
CONF = _PACKAGE / "conf" if (_PACKAGE / "conf").is_dir() else _CHECKOUT / "conf"


def _outputs_folder() -> str:
    # A checkout keeps its runs whatever the current folder is; an installed package has no place of its own.
    return str((_CHECKOUT if CONF.parent == _CHECKOUT else Path.cwd()) / "outputs")


def _help(config_name: str) -> str:
    verb = "train" if config_name == "config" else config_name
    verbs = "\n".join(f"  {verb:15}{purpose}" for verb, purpose in VERBS.items())
    return f"python -m atlantis_exp {verb} KEY=VALUE ...\n{VERBS[verb]}\n\n== Verbs ==\n{verbs}\n"


# Our presets reuse the plugins' names so that the plugins validate the keys; Hydra warns.
warnings.filterwarnings("ignore", message=r"\n'hydra/launcher/\w+' is validated against ConfigStore schema")
OmegaConf.register_new_resolver("outputs_folder", _outputs_folder, replace=True)
OmegaConf.register_new_resolver("help", _help, replace=True)
# Of a Ray cluster that is started here, bytes, the least that Ray takes; a running cluster (a string) has its own.
OmegaConf.register_new_resolver("ray_object_store", lambda address: None if address else 78_643_200, replace=True)
# The head that an objective needs, unless a person asks for another.
OmegaConf.register_new_resolver(
    "head_for", lambda objective, other="plain": "quantile" if objective.endswith("quantile") else other, replace=True
)


def checked(schema: type[T], composed: DictConfig) -> T:
    """A composed Hydra config as an instance of its schema class. Raises: ConfigError."""
    tree = OmegaConf.to_container(composed, resolve=True)
    assert isinstance(tree, dict)
    paths = tree.get("paths")
    if isinstance(paths, dict) and isinstance(paths.get("outputs"), str) and paths["outputs"]:
        paths["outputs"] = str(Path(paths["outputs"]).expanduser().absolute())
    return parse(schema, {str(key): value for key, value in tree.items()})


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
