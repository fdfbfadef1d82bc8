"""`python -m atlantis_exp decide model=cnn,resnet_fast`: trains the seeds that the question needs, and answers it."""

import dataclasses
import itertools
from collections.abc import Callable
from functools import partial
from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.commands.compare import margin
from atlantis_exp.commands.jobs import training_of
from atlantis_exp.commands.overrides import read_flags, read_override, swept
from atlantis_exp.config import STRICT, Config
from atlantis_exp.faults import ConfigError
from atlantis_exp.sessions.job import command_line


@dataclass(config=STRICT, kw_only=True, frozen=True)
class DecideConfig(Config):
    """A question about contenders, each a training of this config but for the keys that tell them apart."""

    baseline: str | None
    delta: str | Annotated[float, Field(gt=0)] | Annotated[int, Field(gt=0)] | None
    seeds: Annotated[int, Field(ge=5, le=1_000)]
    error: Annotated[float, Field(gt=0, lt=1)]

    def __post_init__(self) -> None:
        super().__post_init__()
        margin(self.delta)
        if not self.evaluation.at_end:
            raise ConfigError("evaluation.at_end=false: contenders are compared by the evaluation at their end")


_OWN = {field.name for field in dataclasses.fields(DecideConfig)} - {field.name for field in dataclasses.fields(Config)}
_CLOSED = ("seed", "resume", "device", "threads", "compile", "evaluation", "tracking", "budget", "paths")


def _first_contender(arguments: list[str]) -> list[str]:
    """Give Hydra one value of each key that tells contenders apart, and no launcher: it composes, and runs nothing."""
    if read_flags(arguments)[1]:
        raise ConfigError("-m: decide plans its own sweeps; drop -m")
    dropped = (*swept(arguments), *(text for text in arguments if text.startswith(("hydra/", "hydra."))))
    return [argument for argument in arguments if argument not in dropped]


def _work(asked: Asked[DecideConfig]) -> Callable[[], None]:
    from atlantis_exp.comparison.verdict import Question
    from atlantis_exp.sessions.deciding import Request, decide

    config = asked.config
    several = swept(asked.typed)
    if not several:
        raise ConfigError("nothing to decide between: give a key several values, as in model=cnn,resnet_fast")
    keys = [read_override(text).key_or_group for text in several]
    for key in keys:
        if key.split(".")[0] in _CLOSED:
            raise ConfigError(f"{key}: says how contenders are trained or measured, not what they are; one value only")
        if key == "experiment":
            raise ConfigError(
                "experiment: a preset is no single key; name those that differ, as in objective=dqn,quantile"
            )
    fixed = [text for text in asked.overrides if text.lstrip("+~").split("=")[0].split(".")[0] not in _OWN]
    launchers = [text for text in asked.typed if text.startswith(("hydra/launcher=", "hydra.launcher."))]
    delta, relative = margin(config.delta)
    request = Request(
        question=Question(tuple(keys), config.seeds, config.error, delta, relative, config.baseline),
        contenders=[
            tuple(chosen)
            for chosen in itertools.product(
                *(
                    [f"{text.split('=', 1)[0]}={value}" for value in read_override(text).sweep_string_iterator()]
                    for text in several
                )
            )
        ],
        several=several,
        fixed=fixed,
        launcher=launchers,
        job_of=training_of,
        command=command_line("decide", *asked.typed),
    )
    return partial(decide, request)


VERB = Verb("decide", DecideConfig, _work, rewrite=_first_contender)
