"""`python -m atlantis_exp report`: the results that the outputs folder holds, as a table."""

from collections.abc import Callable
from functools import partial

from pydantic.dataclasses import dataclass

from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.config import STRICT, PathsConfig


@dataclass(config=STRICT, kw_only=True, frozen=True)
class ReportConfig:
    """The table of what a store holds."""

    paths: PathsConfig


def _work(asked: Asked[ReportConfig]) -> Callable[[], None]:
    from atlantis_exp.sessions.reporting import report

    return partial(report, paths=asked.config.paths)


VERB = Verb("report", ReportConfig, _work)
