"""What sets of episode scores say, and how surely."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Scores = npt.NDArray[np.float64]


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
        interquartile_mean=interquartile_mean(values),
        standard_error=float(values.std(ddof=1) / np.sqrt(values.size)) if values.size > 1 else 0.0,
    )


def human_normalised(score: float, random: float, human: float) -> float:
    """0 for the random player's score, 1 for the human's (Mnih et al. 2015)."""
    return (score - random) / (human - random)


def interquartile_mean(scores: Scores) -> float:
    """The mean without the lowest and the highest quarter, floor(n / 4) scores each: rliable's IQM."""
    cut = len(scores) // 4  # as scipy's trim_mean to the last bit, but it costs a second to import
    return float(
        np.partition(np.asarray(scores, np.float64), (cut, len(scores) - cut - 1))[cut : len(scores) - cut].mean()
    )


def resample(seeds: Sequence[Scores], resamples: int, rng: np.random.Generator) -> Iterator[Scores]:
    """Draw bootstrap samples of episodes that come by seeds: seeds with replacement, then each one's episodes.

    Each pools the episodes of as many seeds as there are; only one at a time is in memory. Raises: ValueError without
    a seed.
    """
    if not seeds:
        raise ValueError("a bootstrap needs at least one seed")
    pool = np.concatenate(seeds)
    sizes = np.array([seed.size for seed in seeds])
    starts = np.cumsum(sizes) - sizes

    def drawn() -> Scores:
        chosen = rng.integers(len(seeds), size=len(seeds))
        size = sizes[chosen]
        return pool[np.repeat(starts[chosen], size) + rng.integers(np.repeat(size, size))]

    return (drawn() for _ in range(resamples))


def interval(estimates: Sequence[float] | Sequence[Scores] | Scores) -> npt.NDArray[np.float64]:
    """The middle 95 % of bootstrap estimates along their first axis, (2, ...): the percentile method."""
    ends: npt.NDArray[np.float64] = np.percentile(np.asarray(estimates), (2.5, 97.5), axis=0)
    return ends


def probability_of_improvement(scores: Scores, others: Scores) -> float:
    """The probability that one of `scores` exceeds one of `others`, ties counted half: Mann and Whitney's U over all
    pairs, as rliable has it (Agarwal et al. 2021)."""
    ordered = np.sort(others)
    below = np.searchsorted(ordered, scores, "left") + np.searchsorted(ordered, scores, "right")
    return float(below.sum() / (2 * scores.size * others.size))
