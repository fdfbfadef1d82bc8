"""Decide which of several groups of seeds plays better, with a test that allows several looks.

A `Plan` has the numbers of seeds at which to look, and the error that all pairs and looks share. `decide` takes the
look that is due; the next call takes the record of looks that it returns. Each look is Welch's t-test at the error that
it may spend (Lan and DeMets 1983; quadratic in the number of seeds, Kim and DeMets 1987), divided among the open pairs
(Holm 1979). Both divisions are Bonferroni's: they hold for any number of looks and for pairs that share a group. They
fail if scores decide when to look, or if groups of equal mean differ in shape; `condition` tells how much a verdict
depends on that.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import Field
from scipy.special import nctdtr, stdtrit

from atlantis_exp.documents import Said
from atlantis_exp.statistics import probability_of_improvement

Values = npt.NDArray[np.float64]
Pair = tuple[str, str]

FEWEST_SEEDS = 5  # per group; with fewer nothing is decided


def looks_up_to(seeds: int) -> tuple[int, ...]:
    """Return the looks of a plan up to `seeds` per group, halved down to five: 20 gives 5, 10, 20."""
    return (*(looks_up_to(seeds // 2) if seeds // 2 >= FEWEST_SEEDS else ()), seeds)


@dataclass(frozen=True)
class Plan:
    """The looks of a comparison, and the error that it allows."""

    looks: tuple[int, ...] = looks_up_to(10)  # seeds per group, rising from `FEWEST_SEEDS` or more
    error: float = 0.05  # probability of any false verdict, over all pairs and all looks
    delta: float | None = None  # smaller differences do not matter; None: no pair is found equivalent
    relative: bool = False  # whether delta is a share of the baseline's mean, or else of the pair's
    baseline: str | None = None  # the group to compare each other one with; None: all pairs

    def pairs(self, groups: Collection[str]) -> list[Pair]:
        """Return the pairs that are compared, by name: each group with the baseline, or each with each."""
        if self.baseline is None:
            return list(combinations(sorted(groups), 2))
        return [(group, self.baseline) for group in sorted(groups) if group != self.baseline]

    def spendable(self, seeds: int) -> float:
        """Return the error that looks at up to `seeds` may spend: error x (seeds / last look)^2."""
        return self.error * min(1.0, seeds / self.looks[-1]) ** 2


@dataclass(frozen=True)
class Verdict:
    """One look's finding on the difference between the means of two groups; NaN before the first look.

    The verdict rests on the interval: it excludes zero, or lies within delta, exactly if that was found. It covers with
    at least 1 - the plan's error whenever the looks stop, for groups that differ only in their mean.
    """

    group: str
    other: str
    said: Said = "not decided"  # of the group, against the other
    difference: float = np.nan
    low: float = np.nan
    high: float = np.nan
    seeds: int = 0  # of each of the two groups
    detectable: float | None = None  # found with 80 % at these spreads; only if undecided at the end

    @property
    def turned(self) -> "Verdict":
        """The same verdict, seen from the other group."""
        said: Said = {"better": "worse", "worse": "better"}.get(self.said, self.said)  # type: ignore[assignment]
        of = {"group": self.other, "other": self.group, "difference": -self.difference}
        return replace(self, said=said, low=-self.high, high=-self.low, **of)  # type: ignore[arg-type]

    @property
    def leading(self) -> "Verdict":
        """The same verdict, seen from the group with the higher mean."""
        return self if self.difference > 0 else self.turned


@dataclass(frozen=True)
class Look:
    """A look that was taken, with all that the next one needs; `dataclasses.asdict` gives JSON."""

    seeds: Annotated[dict[str, list[int]], Field(min_length=1)]  # of each tested group
    error: Annotated[float, Field(gt=0, le=1)]  # spent by this look
    verdicts: list[Verdict]  # of the pairs open until then

    @property
    def size(self) -> int:
        """Seeds of each group."""
        return min(map(len, self.seeds.values()))


@dataclass(frozen=True)
class Decision:
    """A verdict for each pair, the looks taken, and when the next one is due."""

    verdicts: list[Verdict]
    looks: list[Look]
    next_look: int | None  # seeds per contender; None after the last look, or once all pairs are decided

    @property
    def contenders(self) -> list[str]:
        """The groups in open pairs, which need seeds while a look is left."""
        return _names((verdict.group, verdict.other) for verdict in self.verdicts if verdict.said == "not decided")

    @property
    def spent(self) -> float:
        """The error that all looks have spent."""
        return sum(look.error for look in self.looks)


def decide(
    groups: Mapping[str, Mapping[int, float]], plan: Plan, looks: Sequence[Look] = (), *, now: bool = False
) -> Decision:
    """Take the look that is due, if any, and return all verdicts.

    A look is due when all contenders have the seeds of a planned look, or with `now` from `FEWEST_SEEDS` on. It tests
    the first n seeds of each contender, n being the number that all of them have, at most the plan's last look. It
    spends the error allowed up to n that earlier looks left. So a second look at n costs and finds nothing, and an
    unplanned look leaves less for later ones. Decided pairs stay decided.

    If any contender's seeds fall into modes, every group's variance is at least the contenders' average: a group whose
    few seeds all survived is not known to be steady. If the seeds of neither group of a pair differ, the difference
    itself stands for their unknown spread.

    Args:
        groups: one value per seed, by group and seed.
        looks: the looks taken at the plan's pairs, in order.
    """
    pairs, looks = plan.pairs(groups), list(looks)
    verdicts = {pair: Verdict(*pair) for pair in pairs}
    verdicts |= {(verdict.group, verdict.other): verdict for look in looks for verdict in look.verdicts}
    undecided = [pair for pair in pairs if verdicts[pair].said == "not decided"]
    if undecided:
        size = min(plan.looks[-1], *(len(groups[name]) for name in _names(undecided)))
        due = size >= FEWEST_SEEDS if now else any(planned <= size for planned in _looks_left(plan, looks))
        error = _left(plan, size, looks)
        if due and error:
            contenders = {name: groups[name] for name in _names(undecided)}
            look = _look(contenders, undecided, len(pairs), plan, size, error)
            looks.append(look)
            verdicts |= {(verdict.group, verdict.other): verdict for verdict in look.verdicts}
    is_open = any(verdict.said == "not decided" for verdict in verdicts.values())
    following = next(iter(_looks_left(plan, looks)), None) if is_open else None
    return Decision(list(verdicts.values()), looks, following)


@dataclass(frozen=True)
class Modes:
    """The two modes of a group's seeds, such as seeds that survive and seeds that collapse."""

    share: float  # of seeds in the upper mode
    upper: float  # mean of the upper mode
    lower: float  # mean of the lower mode


def modes(values: npt.ArrayLike) -> Modes | None:
    """Return the two modes of values, one per seed; None for one mode or fewer than three values.

    There are two if the largest gap between neighbours exceeds t(0.9975, n - 2) times the standard deviation within the
    parts that it separates: 7.5 times at five seeds, 3.8 times at ten. Normal values pass for two modes in 2 to 5 % of
    cases.
    """
    ordered = np.sort(np.asarray(values, np.float64))
    if ordered.size < 3:
        return None
    gaps = np.diff(ordered)
    lower, upper = np.split(ordered, [gaps.argmax() + 1])
    freedom = ordered.size - 2
    within = np.sqrt((lower.var() * lower.size + upper.var() * upper.size) / freedom)
    if gaps.max() <= stdtrit(freedom, 0.9975) * within:
        return None
    return Modes(upper.size / ordered.size, float(upper.mean()), float(lower.mean()))


def mean_interval(values: npt.ArrayLike) -> tuple[float, float]:
    """Return Student's 95 % interval of the mean over seeds, one value per seed; NaN for fewer than two.

    `python -m benchmarks.decisions` measures its coverage for values that are not normal.
    """
    seeds = np.asarray(values, np.float64)
    if seeds.size < 2:
        return np.nan, np.nan
    half = -stdtrit(seeds.size - 1, 0.025) * seeds.std(ddof=1) / np.sqrt(seeds.size)
    return float(seeds.mean() - half), float(seeds.mean() + half)


def detectable(plan: Plan, spread: float, pairs: int = 1) -> float:
    """Return the least difference that the plan's last look finds with 80 %, in the units of `spread`.

    Args:
        spread: standard deviation over seeds in each of the two groups.
        pairs: number of pairs in the family, all of them open.
    """
    return float(_detectable(_errors(plan)[-1] / pairs, plan.looks[-1], spread))


def equivalence(plan: Plan, spread: float, pairs: int = 1) -> float:
    """Return the least delta at which the last look finds groups of equal mean equivalent with 80 %.

    Units and arguments as for `detectable`.
    """
    freedom, error = 2 * (plan.looks[-1] - 1), _errors(plan)[-1] / pairs
    return float((-stdtrit(freedom, error / 2) + stdtrit(freedom, 0.9)) * np.sqrt(2 / plan.looks[-1]) * spread)


def power(plan: Plan, difference: float, spread: float, pairs: int = 1) -> float:
    """Return the probability that the plan finds a difference.

    It uses the noncentral t of each look alone, as if later looks found all that an earlier one finds, so it slightly
    understates the power. Arguments as for `detectable`.
    """
    looks = np.array(plan.looks)
    freedom = 2 * (looks - 1)
    critical = -stdtrit(freedom, _errors(plan) / pairs / 2)
    noncentrality = abs(difference) / (spread * np.sqrt(2 / looks))
    found = 2 - nctdtr(freedom, noncentrality, critical) - nctdtr(freedom, -noncentrality, critical)  # either tail
    return float(found.max())


@dataclass(frozen=True)
class Condition:
    """How much a verdict depends on the assumption that two groups differ only in their mean."""

    spreads: float  # ratio of the standard deviations, at least 1; inf if one group does not vary
    undone_by: float  # share of the better group's seeds that undoes the verdict by scoring the floor
    unseen: float  # share of such seeds that a look of this size misses in one of twenty cases


def condition(verdict: Verdict, look: Look, groups: Mapping[str, Mapping[int, float]]) -> Condition:
    """Return the condition of a verdict of "better" or "worse".

    The floor is 0, or the lowest seed of the two groups if that is below.
    """
    values = [[groups[name][seed] for seed in look.seeds[name]] for name in (verdict.group, verdict.other)]
    small, large = sorted(float(np.std(row)) for row in values)
    floor = min(0.0, *map(min, values))
    best = max(float(np.mean(row)) for row in values) - floor
    undone_by = abs(verdict.difference) / best if best else 0.0
    spreads = large / small if small else np.inf if large else 1.0
    return Condition(spreads, undone_by, 1 - 0.05 ** (1 / verdict.seeds))


def size_found(verdict: Verdict, look: Look, pairs: int) -> float:
    """Return a decided difference, corrected for the bias that a look finds large ones (Zhong and Prentice 2008).

    It is median-unbiased in units of the estimated standard error, for one look at the level of Holm's first step. Over
    both looks of the default plan the truth is above it in 57 to 69 % of the decisions, if 0.5 to 3 sd apart.

    pairs: those that share the look's error: with delta all of the family, else the open ones.
    """
    freedom = 2 * (verdict.seeds - 1)
    limit = -stdtrit(freedom, look.error / pairs / 2)
    error = (verdict.high - verdict.low) / 2 / limit
    t = float(abs(verdict.difference) / error)

    def above_half(shift: float) -> float:  # smaller share of decided differences, less 1/2
        below = 1 - nctdtr(freedom, -shift, limit)
        upto, smaller = nctdtr(freedom, shift, (limit, t))
        return float((below + smaller - upto) / (below + 1 - upto) - 0.5)

    return float(np.sign(verdict.difference) * error * _falls_to(above_half, t))


def may_be_best(decision: Decision) -> list[str]:
    """Return the groups that were not found worse than another.

    With at least 1 - the plan's error they include the best, if all pairs were compared.
    """
    beaten = {verdict.leading.other for verdict in decision.verdicts if verdict.said in ("better", "worse")}
    return sorted(set(_names((verdict.group, verdict.other) for verdict in decision.verdicts)) - beaten)


def seeds_needed(difference: float, spread: float, error: float = 0.05, pairs: int = 1) -> int | None:
    """Return the seeds per group of the shortest plan that finds a difference with 80 %; None beyond a thousand."""
    sizes = range(FEWEST_SEEDS, 1_001)
    return next((n for n in sizes if power(Plan(looks_up_to(n), error), difference, spread, pairs) >= 0.8), None)


def improvement(one: npt.ArrayLike, other: npt.ArrayLike) -> tuple[float, float, float]:
    """Return the probability that a seed of `one` beats one of `other`, between the ends of its 95 % interval.

    The interval is Newcombe's (2006, method 5), which also holds if one group is entirely above the other.
    """
    seeds, others = np.asarray(one, np.float64), np.asarray(other, np.float64)
    found, half = probability_of_improvement(seeds, others), (seeds.size + others.size) / 2 - 1

    def low(share: float) -> float:
        def above(true: float) -> float:
            spread = true * (1 - true) * (1 + half * ((1 - true) / (2 - true) + true / (1 + true)))
            return float(share - true - 1.96 * np.sqrt(spread / (seeds.size * others.size)))

        return _falls_to(above, share)

    return low(found), found, 1 - low(1 - found)


def _falls_to(zero: Callable[[float], float], high: float) -> float:
    """Find the zero of a falling function between 0 and `high` by bisection."""
    low = 0.0
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if zero(middle) > 0 else (low, middle)
    return (low + high) / 2


def _errors(plan: Plan) -> Values:
    """Return the error that each planned look spends."""
    return np.diff([0.0, *map(plan.spendable, plan.looks)])


def _detectable(error: float, size: int, spread: Values | float) -> Values:
    """Return the difference that Welch's test finds with 80 %: a sum of two quantiles of t."""
    freedom = 2 * (size - 1)
    reach = (-stdtrit(freedom, error / 2) + stdtrit(freedom, 0.8)) * np.sqrt(2 / size)
    return np.asarray(reach * spread, np.float64)


def _left(plan: Plan, size: int, looks: Sequence[Look]) -> float:
    """Return the error that a look at `size` seeds may spend; none if a look as late was taken."""
    if looks and size <= looks[-1].size:
        return 0.0
    left = plan.spendable(size) - sum(look.error for look in looks)
    return left if left > 1e-9 else 0.0  # less is rounding


def _looks_left(plan: Plan, looks: Sequence[Look]) -> list[int]:
    return [planned for planned in plan.looks if _left(plan, planned, looks)]


def _names(pairs: Iterable[Pair]) -> list[str]:
    return sorted({name for pair in pairs for name in pair})


def _look(
    groups: Mapping[str, Mapping[int, float]], pairs: Sequence[Pair], family: int, plan: Plan, size: int, error: float
) -> Look:
    """Test the open pairs of a family with the first `size` seeds of each group, and spend `error`."""
    seeds = {name: sorted(values)[:size] for name, values in groups.items()}
    values = np.array([[groups[name][seed] for seed in chosen] for name, chosen in seeds.items()], np.float64)
    places = {name: place for place, name in enumerate(seeds)}
    one, other = np.array([[places[name] for name in pair] for pair in pairs]).T
    means, variances = values.mean(axis=1), values.var(axis=1, ddof=1)
    if any(modes(row) for row in values):
        variances = np.maximum(variances, variances.mean())
    differences = means[one] - means[other]
    spreads = np.sqrt((variances[one] + variances[other]) / 2)
    spreads = np.where(spreads > 0, spreads, np.abs(differences))
    with np.errstate(invalid="ignore"):  # 0 / 0 if neither group varies
        share = np.nan_to_num(variances[one] / (variances[one] + variances[other]), nan=0.5)
    freedom = (size - 1) / (share**2 + (1 - share) ** 2)  # Welch and Satterthwaite
    margin = np.full(len(pairs), plan.delta or 0.0)
    if plan.relative:
        margin *= np.abs(means[other] if plan.baseline else (means[one] + means[other]) / 2)

    half = np.zeros(len(pairs))
    undecided = found = np.ones(len(pairs), bool)
    while found.any() and undecided.any():
        # Holm's steps: a decided pair leaves its error to the others. With delta any verdict can be wrong, so that all
        # pairs keep theirs.
        level = error / (undecided.sum() if plan.delta is None else family)
        half = np.where(undecided, -stdtrit(freedom, level / 2) * spreads * np.sqrt(2 / size), half)
        low, high = differences - half, differences + half
        equivalent = (-margin < low) & (high < margin)
        found = undecided & (equivalent | (low > 0) | (high < 0))
        undecided = undecided & ~found
    said = np.select((undecided, equivalent, low > 0), ("not decided", "equivalent", "better"), "worse").tolist()
    reach = _detectable(level, size, spreads)
    verdicts = [
        Verdict(
            *pair,
            said=said[row],
            difference=float(differences[row]),
            low=float(low[row]),
            high=float(high[row]),
            seeds=size,
            detectable=float(reach[row]) if size == plan.looks[-1] and undecided[row] else None,
        )
        for row, pair in enumerate(pairs)
    ]
    return Look(seeds, error, verdicts)
