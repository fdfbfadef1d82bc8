"""`python -m atlantis_exp query`: describe the environment (report figures 1.1 to 1.3)."""

from collections.abc import Callable
from functools import partial

from pydantic.dataclasses import dataclass

from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.config import STRICT, Env, Format


@dataclass(config=STRICT, kw_only=True, frozen=True)
class QueryConfig:
    """A query of the environment."""

    env: Env
    format: Format


def _work(asked: Asked[QueryConfig]) -> Callable[[], None]:
    from atlantis_exp.sessions.querying import query

    return partial(query, env=asked.config.env)


VERB = Verb("query", QueryConfig, _work)
