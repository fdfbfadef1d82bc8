"""The launchers that run a sweep's trainings in other processes: joblib on this machine, Slurm on a cluster."""

from collections.abc import Mapping
from typing import Any, NamedTuple


class Launcher(NamedTuple):
    """An option of `hydra/launcher` with its settings; the basic one runs jobs in turn in the sweep's process."""

    name: str = "basic"
    settings: Mapping[str, Any] = {}

    @property
    def is_basic(self) -> bool:
        """Whether the jobs run in the sweep's own process."""
        return self.name == "basic"


BASIC = Launcher()
