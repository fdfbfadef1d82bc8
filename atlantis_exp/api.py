"""Train, evaluate and compare from Python, as the verbs of these names do at a command line.

Each function takes a verb's overrides as they are typed, one text each. What a command line ends with an exit code is
raised here: ConfigError for a mistake, Fault for what fails later, KeyboardInterrupt after a Ctrl-C has been committed.
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
    """Train one network, continue it, or return it if its training has ended: `train("model=resnet", "seed=1")`.

    Returns its folder: `.name`, `.path`, and `.result`, which is None as long as the training has not ended.
    """
    config, _ = _done(_training.VERB, overrides)
    return RunFolder.of(config)


def evaluate(*overrides: str) -> RunFolder:
    """Play a run's network or exported weights: `evaluate(f"run={run.name}", "episodes=20")`.

    Returns the evaluation's folder, whose `.result.report` is the report's table.
    """
    return cast(RunFolder, _done(_evaluating.VERB, overrides)[1])


def compare(*overrides: str) -> Comparison:
    """Compare finished runs, taking the looks that are due: `compare("by=model").verdict`. Tables are lists of rows."""
    return cast(Comparison, _done(_comparing.VERB, overrides)[1])


def _done(verb: Verb[T], overrides: tuple[str, ...]) -> tuple[T, object]:
    """Return the checked config of one job, and what its verb returns."""
    _, asked = verb.read(overrides)
    if len(asked) > 1:
        raise ConfigError(f"{' '.join(overrides)}: makes {len(asked)} jobs; call {verb.name} once for each")
    try:
        return asked[0].config, verb.work(asked[0])()
    except SystemExit as end:  # what was interrupted is committed
        raise KeyboardInterrupt from end
