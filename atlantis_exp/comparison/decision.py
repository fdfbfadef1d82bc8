"""Decide which of several groups of seeds plays better, by a test that may be looked at more than once.

A `Plan` says at which numbers of seeds to look, and which error all pairs and all looks share. `decide` takes the look
that is due; the record of looks that it returns is the input of the next call. Each look tests by Welch's t with the
error that it may spend (Lan and DeMets 1983; quadratic in the number of seeds, Kim and DeMets 1987), divided among the
pairs that are open (Holm 1979). Both divisions are Bonferroni's, so they hold for any number of looks and for pairs
that share a group. They do not hold if the scores say when to look, or if groups of one mean differ in shape:
`condition` says how far a verdict is from that.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import numpy.typing as npt
from scipy.special import nctdtr, stdtrit

from atlantis_exp.documents import Said
from atlantis_exp.statistics import probability_of_improvement

Values = npt.NDArray[np.float64]
Pair = tuple[str, str]

FEWEST_SEEDS = 5  # a group; with fewer nothing is decided


def looks_up_to(seeds: int) -> tuple[int, ...]:
    """Return the looks of a plan that ends at `seeds` a group: each halving down to five, so 20 gives 5, 10, 20."""
    return (*(looks_up_to(seeds // 2) if seeds // 2 >= FEWEST_SEEDS else ()), seeds)


@dataclass(frozen=True)
class Plan:
    """At which numbers of seeds a group a comparison looks, and what it may get wrong."""

    looks: tuple[int, ...] = looks_up_to(10)  # seeds a group, rising from `FEWEST_SEEDS` or more
    error: float = 0.05  # probability of any false verdict, over all pairs and all looks
    delta: float | None = None  # a difference below it does not matter; without it nothing is found equivalent
    relative: bool = False  # whether delta is a share of the baseline's mean, without a baseline of the pair's mean
    baseline: str | None = None  # the group that each other one is compared with, in place of all pairs

    def pairs(self, groups: Collection[str]) -> list[Pair]:
        """Return the pairs that are compared, by name: each group with the baseline, or each with each."""
        if self.baseline is None:
            return list(combinations(sorted(groups), 2))
        return [(group, self.baseline) for group in sorted(groups) if group != self.baseline]

    def spendable(self, seeds: int) -> float:
        """Return the error that looks up to so many seeds may spend: error x (seeds / last look)^2."""
        return self.error * min(1.0, seeds / self.looks[-1]) ** 2


@dataclass(frozen=True)
class Verdict:
    """What one look said of the mean over one group's seeds less that over another's; NaN before the first look.

    The verdict rests on the interval: it leaves out zero, or lies within delta, exactly if that was found. It covers
    with at least 1 - the plan's error whenever the looks stop, for groups that differ in their mean only.
    """

    group: str
    other: str
    said: Said = "not decided"  # of the group, against the other
    difference: float = np.nan
    low: float = np.nan
    high: float = np.nan
    seeds: int = 0  # of each of the two groups, that it rests on
    detectable: float | None = None  # the difference found with 80 % at these spreads; after the last look, undecided

    @property
    def turned(self) -> "Verdict":
        """The same of the other group, against this one."""
        said: Said = {"better": "worse", "worse": "better"}.get(self.said, self.said)  # type: ignore[assignment]
        of = {"group": self.other, "other": self.group, "difference": -self.difference}
        return replace(self, said=said, low=-self.high, high=-self.low, **of)  # type: ignore[arg-type]

    @property
    def leading(self) -> "Verdict":
        """It, seen from the group with the higher mean."""
        return self if self.difference > 0 else self.turned


@dataclass(frozen=True)
class Look:
    """One look that was taken, and all that the next one must know of it; `dataclasses.asdict` gives JSON."""

    seeds: dict[str, list[int]]  # of each group that was looked at
    error: float  # spent by this look
    verdicts: list[Verdict]  # of the pairs that were open

    @property
    def size(self) -> int:
        """Seeds of each group."""
        return min(map(len, self.seeds.values()))


@dataclass(frozen=True)
class Decision:
    """A verdict for each pair, the looks taken, and when the next one is due."""

    verdicts: list[Verdict]
    looks: list[Look]
    next_look: int | None  # seeds a contender; None after the last look, and where all pairs are decided

    @property
    def contenders(self) -> list[str]:
        """The groups in open pairs, which need seeds as long as there is a next look."""
        return _names((verdict.group, verdict.other) for verdict in self.verdicts if verdict.said == "not decided")

    @property
    def spent(self) -> float:
        """The error that all looks have spent."""
        return sum(look.error for look in self.looks)


def decide(
    groups: Mapping[str, Mapping[int, float]], plan: Plan, looks: Sequence[Look] = (), *, now: bool = False
) -> Decision:
    """Take the look that is due, if one is, and say what is decided.

    A look is due when all contenders have the seeds of a planned one that has not been taken, or with `now` at any
    number of seeds from `FEWEST_SEEDS`. It takes the first n seeds of each contender by number, n being what all of
    them have and at most the plan's last look, and spends what may be spent by n less what is spent. So a look at the
    same n costs nothing and finds nothing, and an unplanned look leaves less for those to come. What is decided stays
    decided.

    If any contender's seeds fall into modes, no group's variance counts for less than the contenders' average: a group
    whose few seeds all survived is not known to be steady. If no seed of a pair differs from its group's, the
    difference itself stands for their unknown spread.

    Args:
        groups: one value a seed, by group and seed.
        looks: the record of the looks taken at the plan's pairs, in order.
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
    """The two modes that the seeds of a group fall into, as of those that survive and those that collapse."""

    share: float  # of seeds in the upper mode
    upper: float  # mean of the upper mode
    lower: float  # mean of the lower mode


def modes(values: npt.ArrayLike) -> Modes | None:
    """Return the two modes of values, one a seed; None if they look like one mode or are fewer than three.

    There are two if the largest gap between neighbours exceeds t(0.9975, n - 2) times the standard deviation within
    the two parts that it separates: 7.5 times at five seeds, 3.8 times at ten. Normal values seem to be two modes in
    2 to 5 % of cases.
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


def mean_interval(values: npt.ArrayLike, level: float = 0.95) -> tuple[float, float]:
    """Return Student's interval of the mean over seeds, one value a seed; NaN for fewer than two.

    `python -m benchmarks.decisions` shows what it covers of values that are not normal.
    """
    seeds = np.asarray(values, np.float64)
    if seeds.size < 2:
        return np.nan, np.nan
    half = -stdtrit(seeds.size - 1, (1 - level) / 2) * seeds.std(ddof=1) / np.sqrt(seeds.size)
    return float(seeds.mean() - half), float(seeds.mean() + half)


def detectable(plan: Plan, spread: float, pairs: int = 1) -> float:
    """Return the least difference that the plan's last look finds with 80 %, in the units of `spread`.

    Args:
        spread: standard deviation over seeds of each of the two groups.
        pairs: in the family, none of which has been decided.
    """
    return float(_detectable(_errors(plan)[-1] / pairs, plan.looks[-1], spread))


def equivalence(plan: Plan, spread: float, pairs: int = 1) -> float:
    """Return the least delta within which the last look finds two groups of one mean equivalent with 80 %.

    Units and arguments as for `detectable`.
    """
    freedom, error = 2 * (plan.looks[-1] - 1), _errors(plan)[-1] / pairs
    return float((-stdtrit(freedom, error / 2) + stdtrit(freedom, 0.9)) * np.sqrt(2 / plan.looks[-1]) * spread)


def power(plan: Plan, difference: float, spread: float, pairs: int = 1) -> tuple[float, float]:
    """Return the probability that the plan finds a difference, and the mean number of seeds a group that it takes.

    Both are by the noncentral t of each look alone, as if later looks found all that an earlier one finds: a little
    less power and more seeds than there will be. Arguments as for `detectable`.
    """
    looks = np.array(plan.looks)
    freedom = 2 * (looks - 1)
    critical = -stdtrit(freedom, _errors(plan) / pairs / 2)
    noncentrality = abs(difference) / (spread * np.sqrt(2 / looks))
    found = 2 - nctdtr(freedom, noncentrality, critical) - nctdtr(freedom, -noncentrality, critical)  # either tail
    by_now = np.maximum.accumulate(found)
    return float(by_now[-1]), float(looks[0] + (np.diff(looks) * (1 - by_now[:-1])).sum())


@dataclass(frozen=True)
class Condition:
    """How much a verdict leans on its condition, that the seeds of both groups differ in their mean only."""

    spreads: float  # the larger standard deviation over the smaller; inf where the seeds of one group are equal
    undone_by: float  # share of the better group's seeds that would undo the verdict if they scored the floor
    unseen: float  # share of such seeds that would still escape a look of this size in one of twenty cases


def condition(verdict: Verdict, look: Look, groups: Mapping[str, Mapping[int, float]]) -> Condition:
    """Return the condition of a verdict of "better" or "worse".

    The floor is 0, or the lowest seed of the two groups if that is below.
    """
    values = [[groups[name][seed] for seed in look.seeds[name]] for name in (verdict.group, verdict.other)]
    small, large = sorted(float(np.std(row)) for row in values)
    floor = min(0.0, *map(min, values))
    best = max(float(np.mean(row)) for row in values) - floor
    undone_by = abs(verdict.difference) / best if best else 0.0
    return Condition(large / small if small else np.inf, undone_by, 1 - 0.05 ** (1 / verdict.seeds))


def size_found(verdict: Verdict, look: Look) -> float:
    """Return a decided difference, corrected for the look's finding large ones first (Zhong and Prentice 2008).

    Among the differences decided at this look, as many true ones lie above it as below, by the noncentral t.
    """
    freedom = 2 * (verdict.seeds - 1)
    limit = -stdtrit(freedom, look.error / len(look.verdicts) / 2)
    error = (verdict.high - verdict.low) / 2 / limit
    t = float(abs(verdict.difference) / error)

    def above_half(shift: float) -> float:  # of the differences decided where this is true, the share that is smaller
        below = 1 - nctdtr(freedom, -shift, limit)
        upto, smaller = nctdtr(freedom, shift, (limit, t))
        return float((below + smaller - upto) / (below + 1 - upto) - 0.5)

    return float(np.sign(verdict.difference) * error * _falls_to(above_half, 0.0, t))


def may_be_best(decision: Decision) -> list[str]:
    """Return the groups that no other was found better than.

    With at least 1 - the plan's error they include the best, if each was compared with each.
    """
    beaten = {
        verdict.group if verdict.said == "worse" else verdict.other
        for verdict in decision.verdicts
        if verdict.said in ("better", "worse")
    }
    return sorted(set(_names((verdict.group, verdict.other) for verdict in decision.verdicts)) - beaten)


def seeds_needed(difference: float, spread: float, error: float = 0.05, pairs: int = 1) -> int | None:
    """Return the seeds a group of the shortest plan that finds a difference with 80 %; None beyond a thousand."""
    sizes = range(FEWEST_SEEDS, 1_001)
    return next((n for n in sizes if power(Plan(looks_up_to(n), error), difference, spread, pairs)[0] >= 0.8), None)


def improvement(one: npt.ArrayLike, other: npt.ArrayLike) -> tuple[float, float, float]:
    """Return the probability that a seed of one group beats one of another, between the ends of its 95 % interval.

    The interval is Newcombe's (2006, method 5), which also holds if all seeds of one group are above the other's.
    """
    seeds, others = np.asarray(one, np.float64), np.asarray(other, np.float64)
    found, half = probability_of_improvement(seeds, others), (seeds.size + others.size) / 2 - 1

    def low(share: float) -> float:
        def above(true: float) -> float:
            spread = true * (1 - true) * (1 + half * ((1 - true) / (2 - true) + true / (1 + true)))
            return float(share - true - 1.96 * np.sqrt(spread / (seeds.size * others.size)))

        return _falls_to(above, 0.0, share)

    return low(found), found, 1 - low(1 - found)


def _falls_to(zero: Callable[[float], float], low: float, high: float) -> float:
    """Return where a falling function is zero, by halving."""
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if zero(middle) > 0 else (low, middle)
    return (low + high) / 2


def _errors(plan: Plan) -> Values:
    """Return what each planned look spends."""
    return np.diff([0.0, *map(plan.spendable, plan.looks)])


def _detectable(error: float, size: int, spread: Values | float) -> Values:
    """Return the difference that Welch's test finds with 80 %, the sum of two quantiles of t."""
    freedom = 2 * (size - 1)
    reach = (-stdtrit(freedom, error / 2) + stdtrit(freedom, 0.8)) * np.sqrt(2 / size)
    return np.asarray(reach * spread, np.float64)


def _left(plan: Plan, size: int, looks: Sequence[Look]) -> float:
    """Return the error that a look at `size` seeds may spend: none if it is not later than those taken."""
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
    """Test the open pairs of a family by the first `size` seeds of each group, and spend `error`."""
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
    with np.errstate(invalid="ignore"):  # 0 / 0 where neither group varies
        share = np.nan_to_num(variances[one] / (variances[one] + variances[other]), nan=0.5)
    freedom = (size - 1) / (share**2 + (1 - share) ** 2)  # Welch and Satterthwaite
    margin = np.full(len(pairs), plan.delta or 0.0)
    if plan.relative:
        margin *= np.abs(means[other] if plan.baseline else (means[one] + means[other]) / 2)

    half = np.zeros(len(pairs))
    undecided = found = np.ones(len(pairs), bool)
    while found.any() and undecided.any():
        # Holm's steps: what is decided leaves its error to the others. With delta each pair can be wrong whatever is
        # true, so that none is spared.
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
