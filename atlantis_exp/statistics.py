"""What sets of episode scores say, and how surely."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.stats import t as student_t
from scipy.stats import trim_mean

Scores = npt.NDArray[np.float64]

FEWEST_SEEDS = 3  # a group, below which no spread is to be trusted
RANDOM_SCORE = 12_850.0  # of the random player, as published; Quan and Ostrovski, dqn_zoo/atari_data.py
HUMAN_SCORE = 29_028.1  # of the professional tester; the same table
EARLY_FRAMES = 10_000_000  # of training, up to which published DQN stays below the random player or near it


TABLE_COLUMNS = ("mean", "standard_error", "median", "interquartile_mean", "high", "low")
"""The parts of a summary that a line of a table has, in their order."""


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


def human_normalised(score: float) -> float:
    """0 for the published random player, 1 for the published human (Mnih et al. 2015)."""
    return (score - RANDOM_SCORE) / (HUMAN_SCORE - RANDOM_SCORE)


def interquartile_mean(scores: Scores) -> float:
    """The mean without the lowest and the highest quarter, floor(n / 4) scores each: rliable's IQM."""
    return float(trim_mean(scores, 0.25))


def resample(seeds: Sequence[Scores], resamples: int, rng: np.random.Generator) -> list[Scores]:
    """Bootstrap samples of episodes that come by seeds: seeds are drawn with replacement, then each one's episodes.

    Every returned array pools the episodes of as many seeds as there are. Raises ValueError without a seed.
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

    return [drawn() for _ in range(resamples)]


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


@dataclass(frozen=True)
class Difference:
    """How far the mean over one group's seeds lies above another's, with Welch's 95 % interval.

    The ends are NaN where a group has a single seed, which says nothing about the next one.
    """

    value: float
    low: float
    high: float
    more_seeds: int | None  # about, in each group, until it is decided; None where a thousand would not do

    @property
    def is_decided(self) -> bool:
        """Whether there are seeds enough and the interval leaves out zero."""
        return self.more_seeds == 0


def difference(seeds: npt.ArrayLike, others: npt.ArrayLike) -> Difference:
    """Compare two groups by one value a seed (Welch 1947).

    Decided needs `FEWEST_SEEDS` in each group and an interval without zero. `more_seeds` is the least n that is enough
    for both when means and variances stay as they are, less the size of the smaller group.
    """
    groups = [np.asarray(values, np.float64) for values in (seeds, others)]
    value = float(groups[0].mean() - groups[1].mean())
    smaller = min(group.size for group in groups)
    if smaller < 2:
        return Difference(value, np.nan, np.nan, FEWEST_SEEDS - smaller)
    variances = [float(group.var(ddof=1)) for group in groups]
    half = _half_width(variances, [group.size for group in groups])
    more: int | None = 0
    if smaller < FEWEST_SEEDS or abs(value) <= half:
        sizes = range(max(FEWEST_SEEDS, smaller + 1), 1_000)
        more = next((n - smaller for n in sizes if abs(value) > _half_width(variances, [n, n])), None)
    return Difference(value, value - half, value + half, more)


def _half_width(variances: Sequence[float], sizes: Sequence[int]) -> float:
    """Of Welch's 95 % interval; degrees of freedom by Welch and Satterthwaite."""
    errors = [variance / size for variance, size in zip(variances, sizes, strict=True)]
    if sum(errors) == 0:
        return 0.0
    freedom = sum(errors) ** 2 / sum(error**2 / (size - 1) for error, size in zip(errors, sizes, strict=True))
    return float(student_t.ppf(0.975, freedom) * np.sqrt(sum(errors)))
