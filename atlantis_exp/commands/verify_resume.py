"""`python -m atlantis_exp verify-resume overrides`: is a training that is killed repeatedly the unbroken one?"""

from collections.abc import Callable
from functools import partial

from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.commands.jobs import job_of
from atlantis_exp.config import Config


def _work(asked: Asked[Config]) -> Callable[[], None]:
    from atlantis_exp.sessions.verifying import verify_resume

    return partial(verify_resume, job_of(asked))


VERB = Verb("verify-resume", Config, _work)
