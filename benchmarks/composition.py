"""Compose configs for the benchmarks; apart from `contest`, since most contestants start faster without Hydra."""

from atlantis_exp.commands.overrides import check
from atlantis_exp.config import Config


def composed(*overrides: str) -> Config:
    """Return a training's config as the command line composes it. Raises: ConfigError."""
    (config,) = check("config", Config, overrides).values()
    return config
