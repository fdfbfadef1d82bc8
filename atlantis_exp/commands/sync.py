"""`python -m atlantis_exp sync`: run folders into an MLflow store, to a server, or from one into folders here."""

from collections.abc import Callable
from functools import partial
from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from atlantis_exp.checking import check_server, check_time, seconds
from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.components import Count
from atlantis_exp.config import STRICT, PathsConfig, TrackingConfig
from atlantis_exp.faults import ConfigError


@dataclass(config=STRICT, kw_only=True, frozen=True)
class SyncConfig:
    """Run folders and an MLflow store or server, brought up to each other."""

    every: str | Count | None  # time between two looks, a number alone in seconds; null: one look
    to: str | None  # a server's address: this one instead of the store that `tracking` names
    from_: Annotated[str | None, Field(alias="from")]  # a server's address: its runs come here
    tracking: TrackingConfig
    paths: PathsConfig

    def __post_init__(self) -> None:
        check_server("to", self.to)
        check_server("from", self.from_)
        if self.to and self.from_:
            raise ConfigError(f"from={self.from_}: goes the other way than to={self.to}; choose one")
        if self.tracking.name == "none":
            raise ConfigError("tracking=none: names no store to bring up to date; choose tracking=mlflow or server")
        check_time("every", self.every, "30s, 10min or 1h30m")

    @property
    def seconds(self) -> int | None:
        """`every` in seconds."""
        return None if self.every is None else seconds(self.every)


def _work(asked: Asked[SyncConfig]) -> Callable[[], None]:
    from atlantis_exp.sessions.syncing import sync

    return partial(sync, **vars(asked.config), seconds=asked.config.seconds)


VERB = Verb("sync", SyncConfig, _work)
