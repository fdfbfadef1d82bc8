"""Run a verb: check its arguments before anything is written, then make the one call that does the work."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from atlantis_exp import interrupts, terminal
from atlantis_exp.commands.composing import admit_plugins
from atlantis_exp.commands.overrides import check, flags_of, launcher, located, refuse_twice, shown
from atlantis_exp.faults import ConfigError
from atlantis_exp.machine import Machine, here
from atlantis_exp.sessions.launchers import Launcher, in_turn
from atlantis_exp.terminal import command_line

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)


@dataclass(frozen=True)
class Asked(Generic[T_co]):
    """A checked config, and the words typed for it."""

    config: T_co
    verb: str
    overrides: tuple[str, ...]  # of this job only, if it is one of a sweep
    typed: tuple[str, ...] = ()  # all arguments, before they became overrides
    machine: Machine = field(default_factory=here)

    @property
    def command(self) -> str:
        """The command that repeats the job."""
        return command_line(self.verb, *self.overrides)


@dataclass(frozen=True)
class Verb(Generic[T]):
    """A verb: the config that it composes, the schema that checks it, and its work."""

    name: str
    schema: type[T]
    work: Callable[[Asked[T]], Callable[[], object]]
    """Imports the session's module and returns the call that does the work. An int from that call is a late signal."""
    config_name: str = ""  # of the file under conf/; by default the verb's name
    rewrite: Callable[[list[str]], list[str]] = list
    """Turns arguments as people write them into Hydra's overrides. Raises: ConfigError."""
    sweep: Callable[[Sequence[Asked[T]], Launcher, Sequence[str]], None] | None = None
    """Does a sweep's jobs with a launcher, given the arguments; None: one after the other."""

    def run(self, arguments: list[str]) -> None:
        """Check the config that the arguments make, and do the work. Raises: ConfigError, Fault, OSError."""
        arguments, asked = self.read(arguments)
        flags = flags_of(arguments)
        if flags.multirun:
            interrupts.hold()
        is_text = flags.cfg or getattr(asked[0].config, "format", "text") == "text"
        with nullcontext() if is_text else terminal.only_documents():
            if flags.cfg:
                print(shown(self.config_name or self.name, arguments), end="")
            elif not flags.multirun:
                with terminal.working(f"{self.name}: loading"):
                    call = self.work(asked[0])
                interrupts.hold()
                call()
            elif self.sweep is not None:
                self.sweep(asked, launcher(arguments), arguments)
            elif not launcher(arguments).is_basic:
                raise ConfigError(f"hydra/launcher: only trainings can be launched, not {self.name}; drop it")
            else:
                in_turn(lambda each: self.work(each)(), asked, terminal.warn)

    def read(self, words: Sequence[str]) -> tuple[list[str], list[Asked[T]]]:
        """Return typed words as Hydra's overrides, and the checked jobs that they ask for. Raises: ConfigError."""
        typed = located(words)
        arguments = self.rewrite(list(typed))
        return arguments, self.asked(arguments, typed)

    def asked(self, arguments: Sequence[str], typed: Sequence[str] = ()) -> list[Asked[T]]:
        """Check every job that arguments ask for. Raises: ConfigError."""
        admit_plugins([])  # drop the plugins of an earlier command of this process
        refuse_twice(arguments)
        jobs = check(self.config_name or self.name, self.schema, arguments)
        return [Asked(config, self.name, texts, tuple(typed)) for texts, config in jobs.items()]
