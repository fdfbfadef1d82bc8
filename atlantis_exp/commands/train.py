"""`python -m atlantis_exp [train] overrides`: train a network, continue it, or print its result."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.commands.jobs import job_of
from atlantis_exp.commands.overrides import flags_of, key_of, swept
from atlantis_exp.config import Config
from atlantis_exp.sessions.job import command_line
from atlantis_exp.sessions.launchers import Launcher


def _work(asked: Asked[Config]) -> Callable[[], object]:
    from atlantis_exp.sessions.training import train

    return partial(train, job_of(asked))


def _sweep(asked: Sequence[Asked[Config]], launcher: Launcher, arguments: Sequence[str]) -> None:
    if len(asked) == 1 and launcher.is_basic:
        _work(asked[0])()
        return
    from atlantis_exp.sessions.launchers.joblib import fitting
    from atlantis_exp.sessions.sweep import say_hours, sweep

    jobs = [job_of(each) for each in asked]
    if not any(key_of(text) == "hydra/launcher" for text in flags_of(arguments).overrides):
        launcher = fitting(jobs, len(jobs))
        say_hours(jobs, launcher)
    sweep(jobs, launcher, swept(arguments), command_line(*arguments), train_on_a_node)


def train_on_a_node(overrides: Sequence[str]) -> None:
    """Train one job in a process that Slurm has started. Raises: Fault."""
    from atlantis_exp.sessions.training import train

    (asked,) = VERB.asked(overrides)
    train(job_of(replace(asked, machine=replace(asked.machine, launcher="slurm"))))


VERB = Verb("train", Config, _work, config_name="config", sweep=_sweep)
