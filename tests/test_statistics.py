"""Summaries against scipy, rliable and a naive oracle."""

import statistics
from random import Random

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st
from rliable import metrics

from atlantis_exp.statistics import (
    Scores,
    human_normalised,
    probability_of_improvement,
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


def test_human_normalised_is_zero_for_the_random_player_and_one_for_the_human() -> None:
    random, human = 12_850.0, 29_028.1
    assert [human_normalised(score, random, human) for score in (random, human)] == [0, 1]
    assert human_normalised(85_641.0, random, human) == pytest.approx(4.499, abs=1e-3)  # 449.9 % in Mnih et al. 2015
