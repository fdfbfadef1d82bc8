"""The benchmark of decisions, at its smallest."""

import json

import numpy as np
import pytest

from atlantis_exp.decision import Plan
from benchmarks import decisions


@pytest.mark.slow
def test_decisions_prints_its_tables_and_ends_in_one_line_of_json(capsys: pytest.CaptureFixture[str]) -> None:
    decisions.main(["--simulations", "8"])
    results = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert {"worst_false_decision", "power", "seeds", "coverage", "different_shapes", "equivalent"} <= results.keys()
    assert 0 <= results["worst_false_decision"] <= 1
    assert {"t", "percentile", "BCa", "studentized"} == results["coverage"]["mean, normal, 3 seeds"].keys()


def test_whoever_asks_after_every_seed_gets_the_verdicts_of_whoever_trains_as_advised() -> None:
    plan = Plan()
    values = decisions.bimodal(np.random.default_rng(0), (20, 3, decisions.SEEDS))
    for groups in values + np.array([[0.0], [0.5], [1.5]]):
        assert decisions.advised(groups, plan) == decisions.one_by_one(groups, plan)
