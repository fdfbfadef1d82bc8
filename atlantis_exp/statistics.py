"""Summaries, intervals and comparisons of episode scores."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Scores = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Summary:
    """Points of a score distribution (report figures 5.4, 5.5 and 5.9), in the order of an evaluation's metrics."""

    mean: float
    median: float
    high: float
    low: float
    lower_quartile: float
    upper_quartile: float
    interquartile_mean: float
    standard_error: float  # of the mean; 0 for a single episode
    episodes: int


def summarize(scores: Sequence[float] | npt.NDArray[np.float64]) -> Summary:
    """Summarize at least one score; quartiles are interpolated linearly. Raises: ValueError without scores."""
    values = np.asarray(scores, dtype=np.float64)
    if values.size == 0:
        raise ValueError("a summary needs at least one score")
    lower, median, upper = np.percentile(values, (25, 50, 75))
    return Summary(
        episodes=values.size,
        mean=float(values.mean()),
        median=float(median),
        high=float(values.max()),
        low=float(values.min()),
        lower_quartile=float(lower),
        upper_quartile=float(upper),
        interquartile_mean=interquartile_mean(values),
        standard_error=float(values.std(ddof=1) / np.sqrt(values.size)) if values.size > 1 else 0.0,
    )


def human_normalised(score: float, random: float, human: float) -> float:
    """Return a score on a scale of 0 for the random player and 1 for the human (Mnih et al. 2015)."""
    return (score - random) / (human - random)


def interquartile_mean(scores: Scores) -> float:
    """Return the mean without the floor(n / 4) lowest and highest scores: rliable's IQM."""
    low, high = len(scores) // 4, len(scores) - len(scores) // 4
    # Equals scipy's trim_mean to the last bit; importing scipy costs a second.
    return float(np.partition(np.asarray(scores, np.float64), (low, high - 1))[low:high].mean())


def probability_of_improvement(scores: Scores, others: Scores) -> float:
    """Return the probability that one of `scores` exceeds one of `others`; a tie counts half (Agarwal et al. 2021)."""
    ordered = np.sort(others)
    below = np.searchsorted(ordered, scores, "left") + np.searchsorted(ordered, scores, "right")
    return float(below.sum() / (2 * scores.size * others.size))
