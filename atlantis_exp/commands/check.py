"""`python -m atlantis_exp check model=mynet plugins=./mynet.py`: does a component keep its contracts?"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial

from pydantic.dataclasses import dataclass

from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.commands.jobs import job_of, training_of
from atlantis_exp.components import KINDS
from atlantis_exp.config import STRICT, Config, Format
from atlantis_exp.faults import ConfigError
from atlantis_exp.sessions.job import replaced

_SMALL = (  # a training of seconds
    *("phase=quick", "phase.quick.steps=600", "env.num_envs=1", "env.max_steps=50", "budget.forecast=off"),
    *("training.learn_start=20", "training.learn_every=8", "training.batch_size=4", "replay.capacity=200"),
    *("training.precision=fp32", "threads=1", "evaluation.at_end=false", "evaluation.every_episodes=null"),
    *("evaluation.every_steps=null", "tracking=none", "tracking.commit_episodes=2"),
)
_OURS = (  # built-in ones, to compare costs with
    *("model=cnn", "model=resnet", "sampler=uniform", "objective=dqn"),
    *("epsilon=exponential", "lr_schedule=constant", "env=atlantis_standard"),
)


@dataclass(config=STRICT, kw_only=True, frozen=True)
class CheckConfig(Config):
    """A training whose components are tested."""

    format: Format


def _work(asked: Asked[Config]) -> Callable[[], None]:
    from atlantis_exp.sessions.contracts import check, contracts_of

    overrides = tuple(text for text in asked.overrides if not text.startswith("format="))
    job = job_of(replace(asked, overrides=overrides))
    chosen = [text for text in overrides if text.partition("=")[0] in KINDS]
    kinds = [text.partition("=")[0] for text in chosen] or [*KINDS]
    measured = {"\n".join(chosen) or f"model={job.config.model.name}": job}
    for text in _OURS:
        kind = text.partition("=")[0]
        if kind in kinds:
            prefix = "env=" if kind == "env" else kind  # settings of a game's protocol go with any game
            own = [each for each in overrides if not each.startswith(prefix)]
            with suppress(ConfigError):  # other settings may not fit it
                ours = training_of([*own, text])
                if all(ours.config.identity() != each.config.identity() for each in measured.values()):
                    measured[text] = ours
    small = training_of(replaced([text for text in overrides if not text.startswith("phase")], *_SMALL))
    return partial(check, contracts_of(job.config, small, kinds), measured)


VERB = Verb("check", CheckConfig, _work)
