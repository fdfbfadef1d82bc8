"""`python -m atlantis_exp ui`: serve the MLflow UI on the local store."""

from collections.abc import Callable
from functools import partial
from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.config import STRICT, PathsConfig


@dataclass(config=STRICT, kw_only=True, frozen=True)
class UiConfig:
    """The MLflow UI on the local store."""

    port: Annotated[int, Field(ge=1024, le=65535)]
    paths: PathsConfig


def _work(asked: Asked[UiConfig]) -> Callable[[], None]:
    from atlantis_exp.sessions.serving import serve

    return partial(serve, **vars(asked.config))


VERB = Verb("ui", UiConfig, _work)
