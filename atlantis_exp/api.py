"""Train, evaluate and compare from Python.

Each function takes the overrides of the verb of its name, one string each. It raises where the command line would exit:
ConfigError for a mistake, Fault for a later failure, KeyboardInterrupt once a Ctrl-C has been committed.
"""

from typing import TypeVar, cast

from atlantis_exp.commands import compare as _comparing
from atlantis_exp.commands import evaluate as _evaluating
from atlantis_exp.commands import train as _training
from atlantis_exp.commands.app import Verb
from atlantis_exp.comparison.tables import Comparison
from atlantis_exp.faults import ConfigError
from atlantis_exp.runs.folder import RunFolder

T = TypeVar("T")


def train(*overrides: str) -> RunFolder:
    """Train a network, or continue its training: `train("model=resnet", "seed=1")`.

    Returns the run's folder: `.name`, `.path`, and `.result`, which is None until the training has ended.
    """
    config, late = _done(_training.VERB, overrides)
    if late is not None:  # a signal after the last step
        raise KeyboardInterrupt
    return RunFolder.of(config)


def evaluate(*overrides: str) -> RunFolder:
    """Play a run's network or exported weights: `evaluate(f"run={run.name}", "episodes=20")`.

    Returns the evaluation's folder; `.result.report` is its table.
    """
    return cast(RunFolder, _done(_evaluating.VERB, overrides)[1])


def compare(*overrides: str) -> Comparison:
    """Compare finished runs and take due looks: `compare("by=model").verdict`. Tables are lists of rows."""
    return cast(Comparison, _done(_comparing.VERB, overrides)[1])


def _done(verb: Verb[T], overrides: tuple[str, ...]) -> tuple[T, object]:
    """Do a verb's one job; return its checked config and its result."""
    _, asked = verb.read(overrides)
    if len(asked) > 1:
        raise ConfigError(f"{' '.join(overrides)}: makes {len(asked)} jobs; call {verb.name} once for each")
    try:
        return asked[0].config, verb.work(asked[0])()
    except SystemExit as end:  # the interrupted run is committed
        raise KeyboardInterrupt from end
