"""Configs for the benchmarks; apart from `contest`, since most contestants start faster without Hydra."""

from hydra import compose, initialize_config_dir

from atlantis_exp.commands.app import CONF, checked
from atlantis_exp.config import Config


def composed(*overrides: str) -> Config:
    """The config of a training, as the command line composes it."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return checked(Config, compose("config", list(overrides)))
