"""What is trained when."""

import pytest

from atlantis_exp.learning.schedules import Linear
from atlantis_exp.replay.memory import Returns
from atlantis_exp.replay.samplers import UniformSampler
from atlantis_exp.training.plan import Counters, Phase, Plan, Unit, passed


def plan_in(unit: Unit) -> Plan:
    phases = [Phase("a", 2, 0.1, UniformSampler()), Phase("b", 2, 0.2, UniformSampler())]
    return Plan(unit, phases, Linear(1.0, 0.0, 1.0), Linear(1.0, 0.0, 0.5), Returns(0.9), False, 1, 0, 1)


def counted(unit: Unit, done: int) -> Counters:
    return Counters(steps=done) if unit == "steps" else Counters(episodes=done, steps=1_000)


@pytest.mark.parametrize("unit", ["steps", "episodes"])
def test_the_phase_at_a_boundary_is_the_one_that_begins_there(unit: Unit) -> None:
    plan = plan_in(unit)
    names = [plan.phase_at(counted(unit, done)).name for done in (0, 1, 2, 3, 4, 9)]
    assert names == ["a", "a", "b", "b", "b", "b"]
    assert [plan.done(counted(unit, done)) for done in (0, 3)] == [0, 3]
    assert plan.length == 4


@pytest.mark.parametrize("unit", ["steps", "episodes"])
def test_the_learning_rate_is_the_share_of_the_phase_under_way(unit: Unit) -> None:
    rates = [plan_in(unit).learning_rate_at(counted(unit, done)) for done in range(5)]
    assert rates == pytest.approx([0.1, 0.05, 0.0, 0.0, 0.0])


def test_epsilon_counts_the_episode_under_way_and_no_step_under_way() -> None:
    assert [plan_in("steps").epsilon_at(counted("steps", done)) for done in range(5)] == [1.0, 0.75, 0.5, 0.25, 0.0]
    assert [plan_in("episodes").epsilon_at(counted("episodes", done)) for done in range(4)] == [0.75, 0.5, 0.25, 0.0]


@pytest.mark.parametrize(
    ("every", "before", "now", "expected"),
    [
        (10, 0, 9, False),
        (10, 0, 10, True),
        (10, 10, 19, False),
        (10, 9, 31, True),
        (1, 4, 5, True),
        (None, 0, 99, False),
    ],
)
def test_a_multiple_is_passed_once(every: int | None, before: int, now: int, expected: bool) -> None:
    assert passed(every, before, now) is expected
