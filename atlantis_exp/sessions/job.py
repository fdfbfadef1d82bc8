"""One training as it was asked for: its config, what people call it, and the command that repeats it."""

import re
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path

from atlantis_exp.config import Config
from atlantis_exp.machine import Machine, here
from atlantis_exp.terminal import PROGRAM


@dataclass(frozen=True)
class Job:
    """A training to be done by this process, perhaps one of many of a sweep."""

    config: Config
    words: tuple[str, ...] = ()  # what was asked for besides network, sampler and seed, in few words
    overrides: tuple[str, ...] = ()  # as typed, of this job alone
    machine: Machine = field(default_factory=here)

    @property
    def launcher(self) -> str | None:
        """The launcher of the sweep that this process does one job of."""
        return self.machine.launcher

    @property
    def command(self) -> str:
        """What a person types to continue the run or to see its result."""
        return command_line(*self.overrides)

    @property
    def title(self) -> str:
        """What people call the run: network, samplers, seed, then what else was asked for: `resnet top_half s1`."""
        return " ".join([*self._player, f"s{self.config.seed}", *self.words])

    @property
    def group(self) -> str:
        """The title that runs which differ only in their seed have in common."""
        return " ".join([*self._player, *self.words])

    @property
    def colour(self) -> str:
        """The colour of all runs with this network and, in the end, this sampler."""
        return config_colour(self.config)

    @property
    def outputs(self) -> Path:
        """Where everything goes that is written."""
        return Path(self.config.paths.outputs)

    @property
    def _player(self) -> tuple[str, ...]:
        samplers = dict.fromkeys(phase.sampler for phase in self.config.phase.values())
        return (self.config.model.name, *samplers)


def replaced(overrides: Iterable[str], *others: str) -> list[str]:
    """Overrides with others in the place of those that have their keys."""
    keys = {text.partition("=")[0] for text in others}
    return [*(text for text in overrides if text.partition("=")[0].lstrip("+") not in keys), *others]


def command_line(*arguments: str) -> str:
    """A command of ours as a shell takes it."""
    return " ".join((PROGRAM, *map(shlex.quote, arguments)))


def quoted(value: str) -> str:
    """A text as Hydra takes it, in quotes where it would read something else in it."""
    if re.fullmatch(r"[\w/.+-]+", value, re.ASCII):
        return value
    escaped = value.replace("'", r"\'")
    return f"'{escaped}'"


def config_colour(config: Config) -> str:
    """The colour of all runs with this config's network and last sampler."""
    from atlantis_exp.media import run_colour  # numpy, without which a command line is checked

    return run_colour(config.model.name, list(config.phase.values())[-1].sampler)


def labels(title: str, colour: str, kind: str) -> dict[str, str]:
    """The tags by which MLflow shows a run, and tells trainings, sweeps, comparisons apart."""
    return {"mlflow.runName": title, "mlflow.runColor": colour, "atlantis.kind": kind}


def fitted(lines: Sequence[str], room: int, rest: str) -> str:
    """Return as many lines of a note as have room, in characters, then how many more are in `rest`."""
    text = "\n".join(lines)
    if len(text) <= room:
        return text
    more = f"\n\n... and {{:,}} more in {rest}."
    kept = sum(end <= room - len(more) - 5 for end in accumulate(len(line) + 1 for line in lines))
    return "\n".join(lines[:kept]) + more.format(len(lines) - kept)
