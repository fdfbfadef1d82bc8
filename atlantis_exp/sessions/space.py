"""What a search draws its values from."""

from collections.abc import Mapping

from optuna import Trial
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

Space = Mapping[str, CategoricalDistribution | FloatDistribution | IntDistribution]
"""The distribution of each key; a choice's values are texts, as an override has them."""


def suggest(trial: Trial, space: Space) -> None:
    """Draw a trial's values; those that it has been given already stay."""
    for key, drawn in space.items():
        match drawn:
            case CategoricalDistribution():
                trial.suggest_categorical(key, drawn.choices)
            case IntDistribution():
                trial.suggest_int(key, drawn.low, drawn.high, step=drawn.step, log=drawn.log)
            case FloatDistribution():
                trial.suggest_float(key, drawn.low, drawn.high, step=drawn.step, log=drawn.log)
