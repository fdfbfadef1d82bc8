"""The launchers that run a sweep's jobs in other processes: joblib on this machine, Slurm on a cluster."""

from typing import NamedTuple


class Launcher(NamedTuple):
    """An option of `hydra/launcher`; Hydra's own runs the jobs one after the other in the sweep's process."""

    name: str = "basic"
    n_jobs: int | None = None  # at a time, as joblib counts them

    @property
    def is_basic(self) -> bool:
        """Whether the jobs run in the sweep's own process."""
        return self.name == "basic"


BASIC = Launcher()
