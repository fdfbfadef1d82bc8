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
    assert {"t", "percentile", "BCa", "studentized"} == results["coverage"]["mean, normal, 3 seeds"].keys()


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
