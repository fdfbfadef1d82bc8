"""Which network plays Atari Atlantis better on this machine, and how sure are we."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from atlantis_exp.comparison.frames import load_runs

__all__ = ["load_runs"]


def __getattr__(name: str) -> Any:
    # Only who asks for it waits for it: pandas takes longer to import than a command to start.
    if name == "load_runs":
        from atlantis_exp.comparison.frames import load_runs

        return load_runs
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
