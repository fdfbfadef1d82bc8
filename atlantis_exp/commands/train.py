"""`python -m atlantis_exp [train] overrides`: one run; the same command again continues or reports it."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import partial

from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.commands.jobs import job_of
from atlantis_exp.commands.overrides import swept
from atlantis_exp.config import Config
from atlantis_exp.sessions.job import command_line
from atlantis_exp.sessions.launchers import Launcher


def _work(asked: Asked[Config]) -> Callable[[], object]:
    job = job_of(asked)
    match asked.launcher:
        case None:
            from atlantis_exp.sessions.training import train

            return partial(train, job)
        case "joblib":
            from atlantis_exp.sessions.launchers.joblib import train_apart

            return partial(train_apart, job)
        case _:
            from atlantis_exp.sessions.launchers.slurm import train_as_job

            return partial(train_as_job, job)


def _sweep(
    asked: Sequence[Asked[Config]], launcher: Launcher, arguments: Sequence[str]
) -> AbstractContextManager[None]:
    from atlantis_exp.sessions.sweep import ledger

    jobs = [job_of(each) for each in asked]
    return ledger(jobs, swept(arguments), launcher, command_line(*arguments))


VERB = Verb("train", Config, _work, config_name="config", sweep=_sweep)
