"""`python -m atlantis_exp play player=NAME`: track a person at the keyboard."""

from collections.abc import Callable
from functools import partial
from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.config import STRICT, Env, EvaluationConfig, PathsConfig, TrackingConfig


@dataclass(config=STRICT, kw_only=True, frozen=True)
class PlayConfig:
    """A tracked run of a person."""

    player: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,40}$")]
    scale: Annotated[int, Field(ge=1, le=10)]  # window pixels per screen pixel
    env: Env
    evaluation: EvaluationConfig
    tracking: TrackingConfig
    paths: PathsConfig


def _work(asked: Asked[PlayConfig]) -> Callable[[], None]:
    from atlantis_exp.sessions.evaluating import play

    return partial(play, **vars(asked.config), command=asked.command, cores=asked.machine.cores)


VERB = Verb("play", PlayConfig, _work)
