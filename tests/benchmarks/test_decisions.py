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


@pytest.mark.parametrize(
    "asker", ["plans of 5, 6 ... 10 in turn", "a seed left out, ten ways", "five groups, then best and worst"]
)
def test_whoever_asks_again_about_the_same_runs_is_told_what_the_first_question_found(asker: str) -> None:
    ask, groups, size = decisions.ASKERS[asker]
    for values in decisions.normal(np.random.default_rng(1), (6, groups, size)):
        outputs = decisions.Outputs(values)
        ask(outputs)
        found, *others = (
            {(of.group, of.other): of.said for look in asked.record["group"] for of in look.verdicts}
            for asked in outputs.kept.values()
        )
        assert len(others) == {"a": 10, "f": 1, "p": 5}[asker[0]]
        assert all(other.items() <= found.items() for other in others)


def test_a_lowest_seed_that_is_deleted_is_missed_unless_it_has_the_highest_number() -> None:
    ask, *_ = decisions.ASKERS["the leader's lowest seed deleted"]
    values = np.arange(20.0).reshape(2, 10) / 100 + np.array([[0.0], [9.0]])
    outputs = decisions.Outputs(values)
    ask(outputs)
    assert (outputs.false, outputs.silent) == (True, False)
    outputs = decisions.Outputs(values[:, ::-1])
    ask(outputs)
    assert (outputs.false, outputs.silent) == (True, True)
