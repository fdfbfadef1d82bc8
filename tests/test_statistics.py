"""Summaries against scipy, rliable and a naive oracle."""

import statistics
import sys
import tracemalloc
from importlib.util import find_spec
from random import Random
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st
from rliable import metrics

from atlantis_exp.statistics import (
    Scores,
    human_normalised,
    interquartile_mean,
    interval,
    probability_of_improvement,
    resample,
    summarize,
)

SCORES = st.lists(st.integers(0, 50_000).map(lambda hundreds: 100.0 * hundreds), min_size=1, max_size=130)


@given(SCORES)
def test_the_interquartile_mean_is_scipys_and_rliables_to_the_digit(scores: list[float]) -> None:
    ours = summarize(scores).interquartile_mean
    assert ours == scipy.stats.trim_mean(scores, 0.25)
    assert ours == metrics.aggregate_iqm(np.array(scores)[:, np.newaxis])


@given(SCORES)
def test_the_interquartile_mean_is_the_mean_of_what_is_left_after_a_quarter_goes_at_either_end(
    scores: list[float],
) -> None:
    quarter = len(scores) // 4
    middle = sorted(scores)[quarter : len(scores) - quarter]
    assert summarize(scores).interquartile_mean == pytest.approx(sum(middle) / len(middle))


@given(SCORES)
def test_the_other_points_are_numpys_and_the_standard_librarys(scores: list[float]) -> None:
    summary = summarize(scores)
    assert summary.episodes == len(scores)
    assert (summary.low, summary.high) == (min(scores), max(scores))
    assert summary.mean == pytest.approx(statistics.fmean(scores))
    assert summary.median == statistics.median(scores)
    assert (summary.lower_quartile, summary.upper_quartile) == tuple(np.percentile(scores, (25, 75)))
    if len(scores) > 1:
        assert summary.standard_error == pytest.approx(scipy.stats.sem(scores))
        inclusive = statistics.quantiles(scores, n=4, method="inclusive")
        assert (summary.lower_quartile, summary.upper_quartile) == pytest.approx((inclusive[0], inclusive[2]))


@given(SCORES, st.randoms(use_true_random=False))
def test_the_order_of_the_scores_says_nothing(scores: list[float], random: Random) -> None:
    shuffled = list(scores)
    random.shuffle(shuffled)
    assert vars(summarize(shuffled)) == pytest.approx(vars(summarize(scores)))


def test_a_single_score_has_no_spread() -> None:
    summary = summarize([2_000.0])
    assert summary.standard_error == 0.0
    assert summary.mean == summary.median == summary.interquartile_mean == summary.lower_quartile == 2_000.0


def test_no_score_is_no_summary() -> None:
    with pytest.raises(ValueError, match="at least one"):
        summarize([])


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> Any:
    """rliable's bootstrap, which needs that of arch alone: arch as a whole does not import with pandas 3."""
    spec = find_spec("arch")
    assert spec is not None
    arch = ModuleType("arch")
    arch.__path__ = list(spec.submodule_search_locations or ())
    monkeypatch.setitem(sys.modules, "arch", arch)
    from rliable import library

    return library


def column(scores: Scores) -> Scores:
    """Scores as rliable takes them: runs by tasks, one task."""
    return scores[:, np.newaxis]


@settings(deadline=None)
@given(SCORES, SCORES)
def test_the_probability_of_improvement_is_rliables_and_the_share_of_won_pairs(
    scores: list[float], others: list[float]
) -> None:
    x, y = np.array(scores), np.array(others)
    ours = probability_of_improvement(x, y)
    won = sum((a > b) + (a == b) / 2 for a in scores for b in others)
    assert ours == pytest.approx(won / (len(scores) * len(others)), rel=1e-12)
    assert ours == pytest.approx(1 - probability_of_improvement(y, x))
    if len(set(scores + others)) > 1:  # scipy has no U where all are tied
        assert ours == metrics.probability_of_improvement(column(x), column(y))


def test_intervals_are_rliables_to_the_digit_when_the_same_samples_are_drawn(library: Any) -> None:
    scores = np.random.default_rng(3).gamma(2, 4_000, 60).round(-2)
    np.random.seed(5)  # noqa: NPY002 - rliable draws from the global generator
    drawn = [data[0][:, 0] for (data, _) in library.StratifiedBootstrap(column(scores)).bootstrap(500)]
    for statistic, theirs in (
        (interquartile_mean, metrics.aggregate_iqm),
        (lambda sample: float(np.mean(sample)), metrics.aggregate_mean),
    ):
        np.random.seed(5)  # noqa: NPY002
        _, ends = library.get_interval_estimates(
            {"a": column(scores)}, lambda x, theirs=theirs: np.array([theirs(x)]), reps=500
        )
        assert interval([statistic(sample) for sample in drawn]) == pytest.approx(ends["a"][:, 0], rel=1e-14)


def test_a_resample_draws_whole_seeds_and_then_their_episodes() -> None:
    seeds = [np.arange(10.0), np.arange(100.0, 110.0), np.arange(200.0, 210.0)]
    samples = [*resample(seeds, 400, np.random.default_rng(0))]
    for sample in samples:
        assert sample.size == 30
        parts = sample.reshape(3, 10)
        assert all(len(set(part // 100)) == 1 for part in parts)
        assert set(sample) <= {*np.concatenate(seeds)}
    hundreds = [tuple(sorted(sample.reshape(3, 10)[:, 0] // 100)) for sample in samples]
    assert 0.15 < np.mean([len(set(drawn)) == 3 for drawn in hundreds]) < 0.3  # 3! / 3^3 = 0.222
    assert all(len(set(sample.reshape(3, 10)[0])) < 10 for sample in samples[:20])  # episodes come again too


def test_a_bootstrap_of_many_episodes_takes_the_memory_of_one_sample() -> None:
    tracemalloc.start()
    means = [sample.mean() for sample in resample([np.ones(20_000)], 100, np.random.default_rng(0))]
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert means == [1.0] * 100
    assert peak < 10 * 20_000 * 8


def test_with_one_seed_a_resample_is_rliables_of_its_episodes(library: Any) -> None:
    scores = np.random.default_rng(1).gamma(2, 4_000, 200)
    ours = interval([float(s.mean()) for s in resample([scores], 4_000, np.random.default_rng(0))])
    _, theirs = library.get_interval_estimates(
        {"a": column(scores)}, lambda x: np.array([metrics.aggregate_mean(x)]), reps=4_000
    )
    assert ours == pytest.approx(theirs["a"][:, 0], rel=0.02)


def test_seeds_that_differ_widen_the_interval_that_episodes_alone_would_give() -> None:
    rng = np.random.default_rng(0)
    seeds = [rng.normal(level, 10, 50) for level in (1_000, 2_000, 3_000)]
    low, high = interval([float(sample.mean()) for sample in resample(seeds, 1_000, rng)])
    low_pooled, high_pooled = interval([float(s.mean()) for s in resample([np.concatenate(seeds)], 1_000, rng)])
    assert high - low > 3 * (high_pooled - low_pooled)


def test_a_bootstrap_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one seed"):
        resample([], 10, np.random.default_rng(0))


def test_human_normalised_is_zero_for_the_random_player_and_one_for_the_human() -> None:
    random, human = 12_850.0, 29_028.1
    assert [human_normalised(score, random, human) for score in (random, human)] == [0, 1]
    assert human_normalised(85_641.0, random, human) == pytest.approx(4.499, abs=1e-3)  # 449.9 % in Mnih et al. 2015
