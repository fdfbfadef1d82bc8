"""`python -m atlantis_exp search optimizer=adam,rmsprop trials=20`: find the best values of any keys with Optuna."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.commands.jobs import training_of
from atlantis_exp.commands.overrides import key_of, refuse_twice, swept, with_first_values
from atlantis_exp.components import Count
from atlantis_exp.config import FREE, STRICT, Config
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.sessions.job import replaced
from atlantis_exp.terminal import command_line

if TYPE_CHECKING:
    from atlantis_exp.sessions.search import Search


_FIRST_SEED = 1_000  # above all seeds that `decide` trains


@dataclass(config=STRICT, kw_only=True, frozen=True)
class PruningConfig:
    """When to prune a trial: if it is below the median of the others at the same evaluation."""

    trials: Count | None  # that must end before any is pruned; null: never prune
    evaluations: Annotated[int, Field(ge=0)]  # first ones of a trial, at which it is never pruned


@dataclass(config=STRICT, kw_only=True, frozen=True)
class SearchConfig(Config):
    """A training's config, and the search for the best values of some of its keys."""

    trials: Count
    seeds: Count  # trainings per trial
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,59}$")] | None
    startup: Annotated[int, Field(ge=0)]  # trials drawn at random
    pruning: PruningConfig
    space: dict[str, str]  # the values of each key, in Hydra's syntax: `tag(log, interval(1e-5, 1e-3))`

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.evaluation.at_end:
            raise ConfigError("evaluation.at_end=false: a search compares its trials by the evaluation at their end")
        if self.seed < _FIRST_SEED:
            raise ConfigError(f"seed={self.seed}: write 1_000 or more; decide tests the best values with seeds below")


_OWN = {field.name for field in dataclasses.fields(SearchConfig)} - {field.name for field in dataclasses.fields(Config)}
CLOSED = _OWN | FREE | {"seed", "evaluation"}
"""First parts of keys that cannot be searched: they say how trials are run or measured."""


def _first_trial(arguments: list[str]) -> list[str]:
    """Keep only the first value of each searched key."""
    if "-m" in arguments:
        raise ConfigError("-m: a search is not a sweep; drop -m")
    refuse_twice([argument.removeprefix("space.") for argument in arguments])
    return with_first_values(arguments)


def _work(asked: Asked[SearchConfig]) -> Callable[[], None]:
    try:
        from atlantis_exp.sessions.search import search
    except ImportError:
        raise Fault("search needs Optuna: pip install 'atlantis-exp[search]'", exit_code=2) from None
    return partial(search, search_of(asked))


def search_of(asked: Asked[SearchConfig]) -> "Search":
    """Return the search that was asked for. Raises: ConfigError if a value of the space is invalid."""
    from atlantis_exp.commands.space import check_space, read_space
    from atlantis_exp.sessions.search import Search

    config, searched = asked.config, swept(asked.typed)
    texts = config.space | dict(text.removeprefix("space.").split("=", 1) for text in searched)
    if not texts:
        raise ConfigError("nothing to search: give a key several values, as in optimizer=adam,rmsprop")
    keys = {key_of(text) for text in searched}
    fixed = [text for text in asked.overrides if text.startswith("--") or key_of(text) not in keys]
    own = [text for text in fixed if text.lstrip("~").split("=")[0].split(".")[0] in _OWN]
    overrides = replaced([text for text in fixed if text not in own], f"seed={config.seed}")
    space = read_space(texts, CLOSED)
    return Search(
        space=space,
        texts=texts,
        overrides=overrides,
        job_of=training_of,
        corner=check_space(space, overrides),
        trials=config.trials,
        seeds=config.seeds,
        name=config.name,
        startup=config.startup,
        pruned_after=config.pruning.trials,
        spared=config.pruning.evaluations,
        command=command_line("search", *fixed, *searched),
    )


VERB = Verb("search", SearchConfig, _work, rewrite=_first_trial)
