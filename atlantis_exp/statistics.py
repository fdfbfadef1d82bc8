"""What a set of episode scores says."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.stats import trim_mean


@dataclass(frozen=True)
class Summary:
    """Points of a score distribution, as the report prints them (figures 5.4, 5.5 and 5.9)."""

    episodes: int
    mean: float
    median: float
    high: float
    low: float
    lower_quartile: float
    upper_quartile: float
    interquartile_mean: float
    standard_error: float  # of the mean; 0 for a single episode


def summarize(scores: Sequence[float] | npt.NDArray[np.float64]) -> Summary:
    """The summary of at least one score.

    Quartiles are interpolated linearly; the interquartile mean drops floor(n / 4) scores at either end, as
    `scipy.stats.trim_mean(scores, 0.25)` and rliable's IQM do.

    Raises:
        ValueError: without any score.
    """
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
        interquartile_mean=float(trim_mean(values, 0.25)),
        standard_error=float(values.std(ddof=1) / np.sqrt(values.size)) if values.size > 1 else 0.0,
    )
