"""`python -m atlantis_exp compare by=model,sampler`: which group of runs is better, by how much, how surely."""

import re
from collections.abc import Callable
from functools import partial
from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.config import STRICT, PathsConfig, Probability, TrackingConfig


@dataclass(config=STRICT, kw_only=True, frozen=True)
class CompareConfig:
    """Finished runs as groups, and what tells them apart."""

    by: list[str]  # config keys
    runs: list[str]  # names, starts of names or patterns; none: all
    where: list[str]  # KEY=VALUE; none: all
    at_epsilon: Probability | None  # of the evaluations; null: each run's latest
    resamples: Annotated[int, Field(ge=100, le=1_000_000)]  # bootstrap samples
    seed: Annotated[int, Field(ge=0)]  # of the bootstrap
    tracking: TrackingConfig
    paths: PathsConfig


def _list_out(arguments: list[str]) -> list[str]:
    """Let a list be written without brackets, as in `by=model,sampler`."""
    # Hydra itself would take the commas for a sweep, and a second `=` for a mistake.
    return [re.sub(r"^(by|runs|where)=([^\[].*)$", _listed, argument) for argument in arguments]


def _listed(match: re.Match[str]) -> str:
    items = (f"'{item}'" for item in match[2].replace("'", "").split(","))
    return f"{match[1]}=[{','.join(items)}]"


def _work(asked: Asked[CompareConfig]) -> Callable[[], None]:
    from atlantis_exp.comparison.comparing import compare

    return partial(compare, **vars(asked.config), command=asked.command)


VERB = Verb("compare", CompareConfig, _work, rewrite=_list_out)
