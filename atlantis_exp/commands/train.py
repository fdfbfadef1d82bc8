"""`python -m atlantis_exp [train] overrides`: train a network, continue it, or print its result."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.commands.jobs import job_of
from atlantis_exp.commands.overrides import flags_of, key_of, swept
from atlantis_exp.config import Config
from atlantis_exp.faults import ConfigError
from atlantis_exp.sessions.job import Job
from atlantis_exp.sessions.launchers import BASIC, Launcher
from atlantis_exp.terminal import command_line


def _work(asked: Asked[Config]) -> Callable[[], object]:
    from atlantis_exp.sessions.training import train

    return partial(train, job_of(asked))


def _sweep(asked: Sequence[Asked[Config]], launcher: Launcher, arguments: Sequence[str]) -> None:
    if len(asked) == 1 and launcher.is_basic:
        _work(asked[0])()
        return
    from atlantis_exp.sessions.launchers.joblib import fitting
    from atlantis_exp.sessions.sweep import say_hours, sweep

    jobs, first = [job_of(each) for each in asked], dict[str, Job]()
    twins = [job for job in jobs if first.setdefault(job.config.run_name(), job) is not job]
    if not any(key_of(text) == "hydra/launcher" for text in flags_of(arguments).overrides):
        launcher = BASIC if twins else fitting(jobs, len(jobs))
        say_hours(jobs, launcher)
    elif twins and not launcher.is_basic:
        same, other = (" ".join(job.overrides) for job in (twins[0], first[twins[0].config.run_name()]))
        raise ConfigError(f"{same}: makes the same run as {other}; continue it in turn, with hydra/launcher=basic")
    sweep(jobs, launcher, swept(arguments), command_line(*arguments), train_on_a_node)


def train_on_a_node(overrides: Sequence[str]) -> None:
    """Train one job in a process that Slurm has started. Raises: Fault."""
    from atlantis_exp.sessions.training import train

    (asked,) = VERB.asked(overrides)
    train(job_of(replace(asked, machine=replace(asked.machine, launcher="slurm"))))


VERB = Verb("train", Config, _work, config_name="config", sweep=_sweep)
