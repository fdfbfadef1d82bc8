"""`python -m atlantis_exp sync`: publish run folders to an MLflow store or a server."""

from collections.abc import Callable
from functools import partial

from pydantic.dataclasses import dataclass

from atlantis_exp.checking import check_server, check_time, seconds
from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.components import Count
from atlantis_exp.config import STRICT, PathsConfig, TrackingConfig
from atlantis_exp.faults import ConfigError


@dataclass(config=STRICT, kw_only=True, frozen=True)
class SyncConfig:
    """Where to publish run folders, and how often."""

    every: str | Count | None  # time between two passes, seconds without a unit; null: one pass
    to: str | None  # a server's address; null: the store of `tracking`
    tracking: TrackingConfig
    paths: PathsConfig

    def __post_init__(self) -> None:
        check_server("to", self.to)
        if self.tracking.name == "none":
            raise ConfigError("tracking=none: has no store to publish to; choose tracking=mlflow or server")
        check_time("every", self.every, "30s, 10min or 1h30m")

    @property
    def seconds(self) -> int | None:
        return None if self.every is None else seconds(self.every)


def _work(asked: Asked[SyncConfig]) -> Callable[[], None]:
    from atlantis_exp.sessions.syncing import sync

    return partial(sync, **{**vars(asked.config), "every": asked.config.seconds})


VERB = Verb("sync", SyncConfig, _work)
