import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from atlantis_exp.learning.schedules import Constant, Exponential, Linear, LinearSteps, OneCycle

_share = st.floats(0, 1)
_progress = st.floats(0, 10)


@given(value=_share, progress=_progress)
def test_a_constant_stays(value: float, progress: float) -> None:
    assert Constant(value)(progress, 0) == value


@pytest.mark.parametrize(
    ("progress", "epsilon"), [(0.0, 1.0), (0.05, 0.775), (0.1, 0.55), (0.2, 0.1), (0.21, 0.1), (1.0, 0.1), (3.0, 0.1)]
)
def test_a_line_falls_to_its_end_and_stays_there(progress: float, epsilon: float) -> None:
    assert Linear(start=1.0, end=0.1, duration=0.2)(progress, 0) == pytest.approx(epsilon, abs=1e-12)


@pytest.mark.parametrize("progress", [0.0, 0.3, 1.0])
@pytest.mark.parametrize(("steps", "epsilon"), [(0, 1.0), (50, 0.55), (100, 0.1), (101, 0.1), (9_999, 0.1)])
def test_a_line_over_steps_knows_no_progress(steps: int, epsilon: float, progress: float) -> None:
    assert LinearSteps(start=1.0, end=0.1, steps=100)(progress, steps) == pytest.approx(epsilon, abs=1e-12)


@pytest.mark.parametrize(
    ("episode", "epsilon"), [(0, 0.9), (10_000, 0.02 + 0.88 / math.e), (20_000, 0.02 + 0.88 / math.e**2), (10**7, 0.02)]
)
def test_the_exponential_is_the_report_s_over_20_000_episodes(episode: int, epsilon: float) -> None:
    assert Exponential(start=0.9, end=0.02, decay=0.5)(episode / 20_000, 0) == pytest.approx(epsilon, abs=1e-12)


@given(start=_share, end=_share, pace=st.floats(0.01, 1), earlier=_progress, later=_progress)
def test_epsilon_moves_one_way_and_never_leaves_its_ends(
    start: float, end: float, pace: float, earlier: float, later: float
) -> None:
    earlier, later = sorted((earlier, later))
    for schedule in (Linear(start, end, pace), Exponential(start, end, pace)):
        first, second = schedule(earlier, 0), schedule(later, 0)
        assert min(start, end) - 1e-12 <= second <= max(start, end) + 1e-12
        assert abs(second - end) <= abs(first - end) + 1e-12


def test_one_cycle_is_torch_s() -> None:
    optimizer = torch.optim.SGD([torch.zeros(1)], lr=1.0)
    torchs = torch.optim.lr_scheduler.OneCycleLR(optimizer, max_lr=1.0, total_steps=1_001, pct_start=0.3)
    ours = OneCycle(start=0.04, end=4e-6, rise=0.2993)  # torch's climb ends after .3 * 1,001 - 1 steps
    for step in range(1_001):
        assert ours(step / 1_000, 0) == pytest.approx(torchs.get_last_lr()[0], abs=1e-6)
        optimizer.step()
        if step < 1_000:
            torchs.step()


def test_one_cycle_stays_at_its_end() -> None:
    assert OneCycle(start=0.1, end=0.01, rise=0.5)(1.7, 0) == pytest.approx(0.01)
