"""Describe a training that was asked for: its config, title and command."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path

from atlantis_exp.config import Config
from atlantis_exp.machine import Machine, here
from atlantis_exp.terminal import command_line


@dataclass(frozen=True)
class Job:
    """A training for this process, perhaps one of a sweep."""

    config: Config
    words: tuple[str, ...] = ()  # choices besides network, sampler and seed, shortened
    overrides: tuple[str, ...] = ()  # as typed, of this job alone
    machine: Machine = field(default_factory=here)

    @property
    def launcher(self) -> str | None:
        """The launcher of this process's sweep."""
        return self.machine.launcher

    @property
    def command(self) -> str:
        """The command that continues the run or shows its result."""
        return command_line(*self.overrides)

    @property
    def title(self) -> str:
        """The name for people: network, samplers, seed, then other choices: `resnet top_half s1`."""
        return " ".join([*self._player, f"s{self.config.seed}", *self.words])

    @property
    def group(self) -> str:
        """The common title of runs that differ only in their seed."""
        return " ".join([*self._player, *self.words])

    @property
    def colour(self) -> str:
        return config_colour(self.config)

    @property
    def outputs(self) -> Path:
        return Path(self.config.paths.outputs)

    @property
    def _player(self) -> tuple[str, ...]:
        samplers = dict.fromkeys(phase.sampler for phase in self.config.phase.values())
        return (self.config.model.name, *samplers)


def replaced(overrides: Iterable[str], *others: str) -> list[str]:
    """Return overrides with some replaced or added."""
    keys = {text.partition("=")[0] for text in others}
    return [*(text for text in overrides if text.partition("=")[0] not in keys), *others]


def config_colour(config: Config) -> str:
    """Return the colour of all runs with this config's network and last sampler."""
    from atlantis_exp.media import run_colour  # imports numpy, which checking a command line does without

    return run_colour(config.model.name, list(config.phase.values())[-1].sampler)


def labels(title: str, colour: str, kind: str) -> dict[str, str]:
    """Return the tags of a run's name, colour and kind in MLflow."""
    return {"mlflow.runName": title, "mlflow.runColor": colour, "atlantis.kind": kind}


def fitted(lines: Sequence[str], room: int, rest: str) -> str:
    """Return the lines of a note that fit in `room` characters, then how many more `rest` has."""
    text = "\n".join(lines)
    if len(text) <= room:
        return text
    more = f"\n\n... and {{:,}} more in {rest}."
    kept = sum(end <= room - len(more) - 5 for end in accumulate(len(line) + 1 for line in lines))
    return "\n".join(lines[:kept]) + more.format(len(lines) - kept)
