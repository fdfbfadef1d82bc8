"""`python -m atlantis_exp report`: print the results in the outputs folder as a table."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from pydantic.dataclasses import dataclass

from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.commands.compare import list_out
from atlantis_exp.config import STRICT, Format, PathsConfig


@dataclass(config=STRICT, kw_only=True, frozen=True)
class ReportConfig:
    """The runs in the table."""

    runs: list[str]  # names, starts of names or patterns; none: all
    where: list[str]  # KEY=VALUE; none: all
    format: Format
    paths: PathsConfig


def _work(asked: Asked[ReportConfig]) -> Callable[[], None]:
    from atlantis_exp.sessions.reporting import report

    config = asked.config
    return partial(report, Path(config.paths.outputs), config.runs, config.where)


VERB = Verb("report", ReportConfig, _work, rewrite=list_out)
