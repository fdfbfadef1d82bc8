"""The benchmark of decisions, at its smallest."""

import json

import numpy as np
import pytest

from atlantis_exp.comparison.decision import Plan
from benchmarks import decisions


@pytest.mark.slow
def test_decisions_prints_its_tables_and_ends_in_one_line_of_json(capsys: pytest.CaptureFixture[str]) -> None:
    decisions.main(["--simulations", "8"])
    results = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert {"worst_false_decision", "power", "seeds", "coverage", "different_shapes", "equivalent"} <= results.keys()
    assert 0 <= results["worst_false_decision"] <= 1
    assert {"groups", "looks", "false"} == results["worst_shape"].keys()
    assert results["seeds_to_decide_before"].keys() == results["seeds_to_decide_after"].keys()
    assert {"t", "percentile", "BCa", "studentized"} == results["coverage"]["mean, normal, 3 seeds"].keys()


def test_ten_seeds_of_each_network_are_kept() -> None:
    for score, mean in (("last evaluation", 73_397), ("training", 59_979)):
        kept = decisions.kept_seeds(score)
        assert [len(values) for values in kept.values()] == [10, 10]
        assert kept["cnn"].mean() == pytest.approx(mean, abs=1)


def test_shapes_have_a_mean_of_nothing_and_a_spread_of_one() -> None:
    for draw in (*decisions.SHAPES.values(), decisions.rarely, decisions.at_the_cap):
        values = draw(np.random.default_rng(0), (200_000,))
        assert values.mean() == pytest.approx(0, abs=0.02)
        assert values.std() == pytest.approx(1, abs=0.06)


def test_whoever_watches_the_scores_asks_once_and_never_decides_less() -> None:
    plan = Plan()
    values = decisions.normal(np.random.default_rng(0), (200, 2, decisions.SEEDS))
    for groups in values:
        decision, trained = decisions.watching(groups, plan)
        assert [look.size for look in decision.looks] == [trained]
        assert decision.spent == plan.spendable(trained)
        if decisions.false_decision(groups, plan, decisions.advised):
            assert decision.verdicts[0].said != "not decided"


def test_whoever_asks_after_every_seed_gets_the_verdicts_of_whoever_trains_as_advised() -> None:
    plan = Plan()
    values = decisions.bimodal(np.random.default_rng(0), (20, 3, decisions.SEEDS))
    for groups in values + np.array([[0.0], [0.5], [1.5]]):
        assert decisions.advised(groups, plan) == decisions.one_by_one(groups, plan)
