"""`python -m atlantis_exp check model=mynet plugins=./mynet.py`: does a component keep what the rest relies on?"""

from collections.abc import Callable
from contextlib import suppress
from functools import partial

from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.commands.jobs import job_of, training_of
from atlantis_exp.config import Config
from atlantis_exp.faults import ConfigError
from atlantis_exp.sessions.job import replaced

_SMALL = (  # a training of seconds
    *("phase=quick", "phase.quick.steps=600", "env.num_envs=1", "env.max_steps=50", "budget.forecast=off"),
    *("training.learn_start=20", "training.learn_every=8", "training.batch_size=4", "replay.capacity=200"),
    *("training.precision=fp32", "threads=1", "evaluation.at_end=false", "evaluation.every_episodes=null"),
    *("evaluation.every_steps=null", "tracking=none", "tracking.commit_episodes=2"),
)


def _work(asked: Asked[Config]) -> Callable[[], None]:
    from atlantis_exp.sessions.contracts import check

    chosen = [text for text in asked.overrides if not text.startswith("phase")]
    references = [f"model={name}" for name in ("cnn", "resnet")]
    own = [text for text in asked.overrides if not text.startswith("model")]
    others = []
    for text in references:
        if text not in asked.overrides:
            with suppress(ConfigError):  # these settings may be none for a network that nobody asked about
                others.append(training_of([*own, text]))
    return partial(check, job_of(asked), training_of(replaced(chosen, *_SMALL)), others)


VERB = Verb("check", Config, _work)
