"""A verb as a Hydra app: overrides checked before anything is written, then Hydra's own main with all its flags."""

import os
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Generic, NoReturn, TypeVar

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from atlantis_exp import terminal
from atlantis_exp.commands import CONF
from atlantis_exp.commands.composing import admit, checked
from atlantis_exp.commands.overrides import check, is_run, launcher, located, refuse_twice
from atlantis_exp.faults import Fault, remedied
from atlantis_exp.machine import Machine, here
from atlantis_exp.sessions.job import command_line
from atlantis_exp.sessions.launchers import Launcher

T = TypeVar("T")


@dataclass(frozen=True)
class Asked(Generic[T]):
    """What a command line asks for, once: a checked config, and what was typed for it."""

    config: T
    verb: str
    overrides: tuple[str, ...]  # of this job alone, where it is one of a sweep
    launcher: str | None = None  # of the sweep that this process does one job of, but for Hydra's own
    typed: tuple[str, ...] = ()  # all arguments, before they became overrides; empty in a launcher's worker
    machine: Machine = field(default_factory=here)

    @property
    def command(self) -> str:
        """What repeats it, as a shell takes it."""
        return command_line(self.verb, *self.overrides)


@dataclass(frozen=True)
class Verb(Generic[T]):
    """A verb: the config that it composes, the schema that checks it, and what does the work."""

    name: str
    schema: type[T]
    work: Callable[[Asked[T]], Callable[[], object]]
    """Imports what does the work, and returns the call that does it; an int that this returns is a late signal."""
    config_name: str = ""  # of the file under conf/; that of the verb unless it says otherwise
    rewrite: Callable[[list[str]], list[str]] = list
    """From arguments as people write them to Hydra's overrides. Raises: ConfigError."""
    sweep: Callable[[Sequence[Asked[T]], Launcher, Sequence[str]], AbstractContextManager[None]] = lambda *_: (
        nullcontext()
    )
    """From all jobs of a sweep, its launcher and the arguments to the context that the sweep runs in."""

    def run(self, arguments: list[str]) -> None:
        """Compose the config with the arguments, check it, and do the work.

        A user's mistake ends the process with exit code 2 and one line on stderr before Hydra or the work starts; a
        `Fault` ends it with its own exit code and one line, and so does a folder that cannot be written.
        """
        config_name = self.config_name or self.name
        try:
            admit([])  # an earlier command of this process may have named plugins
            arguments = located(arguments)
            typed = tuple(arguments)
            refuse_twice(arguments := self.rewrite(arguments))
            jobs = check(config_name, self.schema, arguments)
            chosen = launcher(config_name, arguments)
            flags = tuple(text for text in arguments if text.startswith("--config-dir="))
            if is_run(arguments):  # which Hydra itself would compose twice more
                ((overrides, config),) = jobs.items()
                with terminal.working(f"{self.name}: loading"):
                    call = self.work(Asked(config, self.name, (*flags, *overrides), here().launcher, typed))
                call()
                return
        except (Fault, OSError) as error:
            exit_with(error)

        @hydra.main(version_base="1.3", config_path=str(CONF), config_name=config_name)
        def task(composed: DictConfig) -> None:
            overrides = (*flags, *HydraConfig.get().overrides.task)
            try:
                config = checked(self.schema, composed)
                late = self.work(Asked(config, self.name, overrides, _job_launcher(), typed))()
            except (Fault, OSError) as error:
                # In a sweep an exit would take the other jobs along, an exception does not.
                if _is_sweep():
                    raise
                exit_with(error)
            if isinstance(late, int) and _is_sweep():  # it came when this job had nothing left to stop
                sys.exit(128 + late)

        sys.argv[1:] = arguments  # which Hydra reads
        os.environ.setdefault("HYDRA_FULL_ERROR", "1")
        asked = [Asked(config, self.name, (*flags, *overrides)) for overrides, config in jobs.items()]
        is_one = len(asked) == 1 and chosen.is_basic
        try:
            with nullcontext() if is_one else self.sweep(asked, chosen, arguments):
                task()
        except (Fault, OSError) as error:
            exit_with(error)


def exit_with(error: Exception) -> NoReturn:
    """End the process with one line and the error's exit code: 2 for a user's mistake."""
    terminal.warn(remedied(error))
    sys.exit(getattr(error, "exit_code", 1))


def _is_sweep() -> bool:
    """Whether Hydra runs this job as one of several."""
    return HydraConfig.get().mode is RunMode.MULTIRUN


def _job_launcher() -> str | None:
    """The launcher that this process does one job of a sweep for; None where that is Hydra's own, or there is none."""
    if (apart := here().launcher) is not None:
        return apart
    if not _is_sweep():
        return None
    name = str(HydraConfig.get().runtime.choices["hydra/launcher"])
    return None if Launcher(name).is_basic else name
