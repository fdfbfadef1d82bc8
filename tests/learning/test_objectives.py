import math
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from atlantis_exp.learning.objectives import (
    DQN,
    RESCALINGS,
    DoubleDQN,
    DoubleQuantile,
    Quantile,
    RescaledDoubleDQN,
    RescaledQuantile,
    action_values,
    td_errors,
)

every_seed = given(seed=st.integers(0, 1000))


def _batch(seed: int, *quantiles: int) -> tuple[Any, ...]:
    """Rewards, discounts, the online and the target network's values at s_tpm, the online network's at s_t."""
    rng = np.random.default_rng(seed)
    rewards = torch.from_numpy(rng.choice([0.0, 100.0, 0.3], 9).astype(np.float32))
    discounts = torch.from_numpy(rng.choice([0.0, 0.9, 0.81], 9).astype(np.float32))
    shape = (9, 4, *quantiles)
    online, target, now = (torch.from_numpy(rng.normal(0, 2, shape).astype(np.float32)) for _ in range(3))
    return rewards, discounts, online, target, now


@every_seed
@pytest.mark.parametrize("objective", [DQN(), DoubleDQN()], ids=repr)
def test_a_target_is_the_target_network_s_value_of_its_own_or_the_online_network_s_best_action(
    objective: DQN, seed: int
) -> None:
    rewards, discounts, online, target, _ = _batch(seed)
    targets = objective.targets(rewards, torch.arange(9), discounts, lambda s: online[s], lambda s: target[s])
    chooser = online if isinstance(objective, DoubleDQN) else target
    for b in range(9):
        best = max(range(4), key=lambda action: float(chooser[b, action]))
        expected = float(rewards[b]) + float(discounts[b]) * float(target[b, best])
        assert targets[b].item() == pytest.approx(expected, rel=1e-5, abs=1e-5)


@every_seed
@pytest.mark.parametrize("objective", [Quantile(5), DoubleQuantile(5)], ids=repr)
def test_quantile_targets_are_the_target_network_s_of_its_own_or_the_online_network_s_best_mean(
    objective: Quantile, seed: int
) -> None:
    rewards, discounts, online, target, now = _batch(seed, 5)
    targets = objective.targets(rewards, torch.arange(9), discounts, lambda s: online[s], lambda s: target[s])
    chooser = online if isinstance(objective, DoubleQuantile) else target
    assert targets.shape == (9, 5)
    for b in range(9):
        best = max(range(4), key=lambda action: sum(chooser[b, action].tolist()))
        for j in range(5):
            expected = float(rewards[b]) + float(discounts[b]) * float(target[b, best, j])
            assert targets[b, j].item() == pytest.approx(expected, rel=1e-5, abs=1e-5)
    actions = torch.arange(9) % 4
    torch.testing.assert_close(
        objective.losses(now, actions, targets), Quantile(5).losses(now, actions, targets), rtol=0, atol=0
    )


def _signed_sqrt(x: float) -> float:
    """Pohlen et al. 2018, proposition A.2, as printed."""
    return math.copysign(math.sqrt(abs(x) + 1) - 1, x) + 0.001 * x


def _undo_signed_sqrt(x: float) -> float:
    return math.copysign(((math.sqrt(1 + 0.004 * (abs(x) + 1 + 0.001)) - 1) / 0.002) ** 2 - 1, x)


WRITTEN_OUT: dict[str, tuple[Callable[[float], float], Callable[[float], float]]] = {
    "signed_sqrt": (_signed_sqrt, _undo_signed_sqrt),
    "symlog": (
        lambda x: math.copysign(math.log(abs(x) + 1), x),
        lambda x: math.copysign(math.exp(abs(x)) - 1, x),
    ),
}


@pytest.mark.parametrize("rescaling", WRITTEN_OUT)
@given(x=st.floats(-1e6, 1e6, width=32))
def test_a_rescaling_is_the_paper_s_and_is_undone(rescaling: str, x: float) -> None:
    rescale, undo = RESCALINGS[rescaling]
    made = rescale(torch.tensor(x))
    assert made.item() == pytest.approx(WRITTEN_OUT[rescaling][0](x), rel=1e-5, abs=1e-6)
    assert undo(made).item() == pytest.approx(x, rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("rescaling", WRITTEN_OUT)
@every_seed
def test_rescaled_targets_are_of_returns_and_of_the_action_with_the_best_rescaled_value(
    rescaling: Literal["signed_sqrt", "symlog"], seed: int
) -> None:
    rescale, undo = WRITTEN_OUT[rescaling]
    rewards, discounts, online, target, now = _batch(seed)
    plain = RescaledDoubleDQN(rescaling)
    targets = plain.targets(rewards, torch.arange(9), discounts, lambda s: online[s], lambda s: target[s])
    for b in range(9):
        best = max(range(4), key=lambda action: float(online[b, action]))
        expected = rescale(float(rewards[b]) + float(discounts[b]) * undo(float(target[b, best])))
        assert targets[b].item() == pytest.approx(expected, rel=1e-4, abs=1e-4)
    actions = torch.arange(9) % 4
    torch.testing.assert_close(plain.losses(now, actions, targets), DQN().losses(now, actions, targets))

    rewards, discounts, online, target, now = _batch(seed, 5)
    quantiles = RescaledQuantile(5, rescaling)
    targets = quantiles.targets(rewards, torch.arange(9), discounts, lambda s: online[s], lambda s: target[s])
    for b in range(9):
        best = max(range(4), key=lambda action: sum(target[b, action].tolist()))
        for j in range(5):
            expected = rescale(float(rewards[b]) + float(discounts[b]) * undo(float(target[b, best, j])))
            assert targets[b, j].item() == pytest.approx(expected, rel=1e-4, abs=1e-4)
    torch.testing.assert_close(quantiles.losses(now, actions, targets), Quantile(5).losses(now, actions, targets))


@pytest.mark.parametrize(
    ("objective", "shape"),
    [(DQN(), (2, 4)), (DoubleDQN(), (2, 4)), (Quantile(5), (2, 4, 3)), (DoubleQuantile(5), (2, 4, 3))],
    ids=str,
)
def test_nothing_comes_through_a_cut_bootstrap(objective: DQN | Quantile, shape: tuple[int, ...]) -> None:
    wild = torch.full(shape, torch.inf)
    targets = objective.targets(torch.tensor([1.0, 2.0]), wild, torch.tensor([0.0, 0.9]), lambda s: s, lambda s: -s)
    assert (targets[0] == 1.0).all()
    assert (targets[1] == -torch.inf).all()


@pytest.mark.parametrize("rescaling", WRITTEN_OUT)
def test_nothing_comes_through_a_cut_bootstrap_of_rescaled_returns(rescaling: Literal["signed_sqrt", "symlog"]) -> None:
    wild = torch.full((2, 4), torch.inf)
    targets = RescaledDoubleDQN(rescaling).targets(
        torch.tensor([1.0, 2.0]), wild, torch.tensor([0.0, 0.9]), lambda s: s, lambda s: -s
    )
    assert targets[0].item() == pytest.approx(WRITTEN_OUT[rescaling][0](1.0))
    assert not targets[1].isfinite()  # which ends a training


@every_seed
def test_the_loss_is_huber_s_of_the_taken_action(seed: int) -> None:
    rewards, _, _, _, q_BA = _batch(seed)
    actions = torch.from_numpy(np.random.default_rng(seed).integers(0, 4, 9))
    for objective in (DQN(), DoubleDQN()):
        losses = objective.losses(q_BA, actions, rewards)
        assert losses.shape == (9,)
        for b in range(9):
            assert losses[b].item() == pytest.approx(_huber(float(q_BA[b, int(actions[b])] - rewards[b])), abs=1e-5)


@every_seed
def test_the_quantile_loss_is_the_paper_s_sum_written_out(seed: int) -> None:
    """Dabney et al. 2018, equations 9 and 10 with kappa 1, and algorithm 1."""
    quantiles = 3
    _, _, _, target, z_BAN = _batch(seed, quantiles)
    actions = torch.from_numpy(np.random.default_rng(seed).integers(0, 4, 9))
    target_BN = target[:, 0]
    losses = Quantile(5).losses(z_BAN, actions, target_BN)
    assert losses.shape == (9,)
    for b in range(9):
        expected = 0.0
        for i in range(quantiles):
            midpoint = (i / quantiles + (i + 1) / quantiles) / 2
            for j in range(quantiles):
                u = float(target_BN[b, j]) - float(z_BAN[b, actions[b], i])
                expected += abs(midpoint - (1 if u < 0 else 0)) * _huber(u) / quantiles
        assert losses[b].item() == pytest.approx(expected, rel=1e-5, abs=1e-5)


def test_the_value_of_an_action_is_the_mean_of_its_quantiles() -> None:
    z_BAN = torch.tensor([[[1.0, 2.0, 6.0], [0.0, 0.0, 9.0]]])
    assert action_values(z_BAN).tolist() == [[3.0, 3.0]]
    assert action_values(z_BAN[:, :, 0]).tolist() == [[1.0, 0.0]]


def _huber(error: float) -> float:
    return error * error / 2 if abs(error) < 1 else abs(error) - 0.5


def test_an_error_is_of_the_taken_action_s_value() -> None:
    q_BA = torch.tensor([[1.0, 5.0], [2.0, 3.0]])
    assert td_errors(q_BA, torch.tensor([1, 0]), torch.tensor([2.0, 2.5])).tolist() == [3.0, 0.5]
    z_BAN = torch.tensor([[[0.0, 2.0], [4.0, 6.0]], [[1.0, 3.0], [3.0, 3.0]]])
    assert td_errors(z_BAN, torch.tensor([1, 0]), torch.tensor([[1.0, 3.0], [5.0, 0.0]])).tolist() == [3.0, 0.5]
