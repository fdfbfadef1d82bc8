"""`python -m atlantis_exp evaluate run=NAME epsilon=0.05`: play a stored run's network, or an exported one."""

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

from pydantic.dataclasses import dataclass

from atlantis_exp.checking import nearest
from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.config import STRICT, Device, EvaluationConfig, PathsConfig, TrackingConfig
from atlantis_exp.faults import ConfigError


@dataclass(config=STRICT, kw_only=True, frozen=True)
class EvaluateConfig:
    """Evaluation of a stored run, or of exported weights."""

    run: str
    weights: str  # latest, best or a folder
    device: Device
    evaluation: EvaluationConfig
    tracking: TrackingConfig
    paths: PathsConfig

    def __post_init__(self) -> None:
        is_folder = "/" in self.weights or Path(self.weights, "card.json").exists()
        if self.weights not in ("latest", "best") and not is_folder:
            hint = nearest(self.weights, ("latest", "best"))
            raise ConfigError(f"weights={self.weights}: not a folder such as pretrained/NAME; {hint}")


def spell_out(arguments: list[str]) -> list[str]:
    """Expand `epsilon=` and `episodes=` to the evaluation's keys."""
    # Hydra would read `epsilon` as the config group of that name.
    return [re.sub(r"^(epsilon|episodes)=", r"evaluation.\1=", argument) for argument in arguments]


def _work(asked: Asked[EvaluateConfig]) -> Callable[[], object]:
    from atlantis_exp.sessions.evaluating import evaluate

    keys = {override.split("=")[0] for override in asked.overrides}
    return partial(evaluate, **vars(asked.config), asked=keys, command=asked.command, cores=asked.machine.cores)


VERB = Verb("evaluate", EvaluateConfig, _work, rewrite=spell_out)
