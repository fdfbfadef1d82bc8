"""`python -m atlantis_exp export run=NAME to=pretrained/NAME`: export a stored run's network to share it."""

from collections.abc import Callable
from functools import partial
from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.commands.evaluate import spell_out
from atlantis_exp.config import STRICT, Device, EvaluationConfig, PathsConfig


@dataclass(config=STRICT, kw_only=True, frozen=True)
class ExportConfig:
    """An export of a stored run's network."""

    run: str
    weights: Literal["latest", "best"]
    to: Annotated[str, Field(min_length=1)] | None
    onnx: bool
    device: Device
    evaluation: EvaluationConfig
    paths: PathsConfig


def _work(asked: Asked[ExportConfig]) -> Callable[[], None]:
    from atlantis_exp.sessions.exporting import export

    return partial(export, **vars(asked.config), cores=asked.machine.cores)


VERB = Verb("export", ExportConfig, _work, rewrite=spell_out)
