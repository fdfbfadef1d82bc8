"""Train networks on Atari Atlantis and decide which one plays better, and how surely."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from atlantis_exp.api import compare, evaluate, train
    from atlantis_exp.comparison.frames import load_runs

__all__ = ["compare", "evaluate", "load_runs", "train"]


def __getattr__(name: str) -> Any:
    # Lazy: pandas and MLflow take longer to import than a command takes to start.
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("atlantis_exp.comparison.frames" if name == "load_runs" else "atlantis_exp.api"), name)
