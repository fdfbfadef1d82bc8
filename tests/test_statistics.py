"""Summaries against scipy, rliable and a naive oracle."""

import statistics
from random import Random

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from rliable import metrics

from atlantis_exp.statistics import summarize

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
