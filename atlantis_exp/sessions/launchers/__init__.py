"""The launchers that run a sweep's trainings in other processes: joblib on this machine, Slurm on a cluster."""

import sys
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple, TypeVar

T = TypeVar("T")


class Launcher(NamedTuple):
    """An option of `hydra/launcher` with its settings; the basic one runs jobs in turn in the sweep's process."""

    name: str = "basic"
    settings: Mapping[str, Any] = {}

    @property
    def is_basic(self) -> bool:
        """Whether the jobs run in the sweep's own process."""
        return self.name == "basic"


BASIC = Launcher()


def in_turn(work: Callable[[T], object], jobs: Iterable[T], say: Callable[[str], object] = lambda _: None) -> None:
    """Do jobs one after the other; go on after an error, and raise the first one at the end.

    A signal that came too late to stop a job ends the process after that job.

    say: called with each error that is not raised.
    """
    first: Exception | None = None
    for job in jobs:
        try:
            late = work(job)
        except Exception as error:
            if first is not None:
                say(str(error))
            first = first or error
        else:
            if isinstance(late, int):
                if first is not None:
                    say(str(first))
                sys.exit(128 + late)
    if first is not None:
        raise first
