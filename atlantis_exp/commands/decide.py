"""`python -m atlantis_exp decide model=cnn,resnet_fast`: train the seeds that a question needs, and answer it."""

import dataclasses
from collections.abc import Callable, Iterable
from functools import cache, partial
from typing import TYPE_CHECKING, Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.commands.compare import QuestionConfig, list_out
from atlantis_exp.commands.jobs import training_of
from atlantis_exp.commands.overrides import (
    flags_of,
    jobs_of,
    key_of,
    launcher,
    read_override,
    refuse_twice,
    swept,
    with_first_values,
)
from atlantis_exp.commands.train import train_on_a_node
from atlantis_exp.config import FREE, STRICT, Config
from atlantis_exp.faults import ConfigError
from atlantis_exp.terminal import command_line

if TYPE_CHECKING:
    from atlantis_exp.sessions.deciding import Contest


@dataclass(config=STRICT, kw_only=True, frozen=True)
class DecideConfig(QuestionConfig, Config):
    """A question about contenders: trainings of this config that differ in a few keys."""

    against: list[str]  # overrides: with all of them, or with none
    seeds: Annotated[int, Field(ge=5, le=1_000)]

    def __post_init__(self) -> None:
        super().__post_init__()
        Config.__post_init__(self)
        if not self.evaluation.at_end:
            raise ConfigError("evaluation.at_end=false: contenders are compared by the evaluation at their end")


_OWN = {field.name for field in dataclasses.fields(DecideConfig)} - {field.name for field in dataclasses.fields(Config)}
_CLOSED = _OWN | FREE | {"seed", "evaluation"}


def _launchers(texts: Iterable[str]) -> list[str]:
    """Return the overrides that choose a launcher and set it up."""
    return [text for text in texts if key_of(text).startswith(("hydra/launcher", "hydra.launcher."))]


def _first_contender(arguments: list[str]) -> list[str]:
    """Return the arguments of the first contender, without a launcher: its config has the keys that all share."""
    flags = flags_of(arguments := list_out(arguments, "against"))
    if flags.multirun:
        raise ConfigError("-m: decide plans its own sweeps; drop -m")
    refuse_twice(arguments)
    for text in flags.overrides:
        override = read_override(text)
        if override.key_or_group == "seed":
            raise ConfigError(f"{text}: decide trains seeds from 0 on, as many as it needs; drop it")
        if override.key_or_group == "resume" and override.value() != "auto":
            raise ConfigError(f"{text}: decide continues the existing runs; drop it")
        if override.is_sweep_override() and not override.is_discrete_sweep():
            raise ConfigError(f"{text}: not a list of values; write them out, as in model=cnn,resnet_fast")
    dropped = _launchers(flags.overrides)
    return with_first_values([argument for argument in arguments if argument not in dropped])


def _work(asked: Asked[DecideConfig]) -> Callable[[], None]:
    from atlantis_exp.sessions.deciding import decide

    return partial(decide, contest_of(asked))


def contest_of(asked: Asked[DecideConfig]) -> "Contest":
    """Return the contest that was asked for. Raises: ConfigError if it cannot be decided."""
    from atlantis_exp.sessions.deciding import Contest

    config, typed = asked.config, list_out(asked.typed, "against")
    several = swept(typed)
    if several and config.against:
        raise ConfigError(f"{several[0]}: write several values or against=, not both")
    overrides = [read_override(text) for text in several or config.against]
    for override in overrides:
        key = override.key_or_group
        if key.split(".")[0] in _CLOSED:
            raise ConfigError(f"{key}: all contenders are trained and measured alike; write one value")
        if key == "experiment":
            raise ConfigError(
                "experiment: a preset sets many keys; name those that differ, as in objective=dqn,quantile"
            )
    contenders = [(), tuple(config.against)] if config.against else [*jobs_of(overrides)]
    if len(contenders) < 2:
        raise ConfigError("nothing to decide between: give a key several values, as in model=cnn,resnet_fast")
    texts = flags_of(typed).overrides  # as typed, before Hydra resolved ${...}
    launchers = _launchers(texts)
    shared = [text for text in texts if text not in (*several, *launchers)]
    fixed = [text for text in shared if text.lstrip("~").split("=")[0].split(".")[0] not in _OWN]
    flags = [text for text in typed if text.startswith("--config-dir=")]
    return Contest(
        config.question(override.key_or_group for override in overrides),
        contenders,
        several=several,
        fixed=fixed,
        launcher=launcher(["-m", *launchers]) if launchers else None,
        on_a_node=train_on_a_node,
        job_of=cache(lambda overrides: training_of([*flags, *overrides])),
        command=command_line("decide", *asked.typed),
    )


VERB = Verb("decide", DecideConfig, _work, rewrite=_first_contender)
