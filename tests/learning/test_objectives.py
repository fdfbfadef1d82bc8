import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from atlantis_exp.learning.objectives import DQN, DoubleDQN

_GAMMA = 0.9


def _batch(seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Rewards, terminated, the online and the target network's values at s_tp1, the online network's at s_t."""
    rng = np.random.default_rng(seed)
    rewards = torch.from_numpy(rng.choice([0.0, 100.0, 0.3], 9).astype(np.float32))
    terminated = torch.from_numpy(rng.random(9) < 0.3)
    online, target, now = (torch.from_numpy(rng.normal(0, 2, (9, 4)).astype(np.float32)) for _ in range(3))
    return rewards, terminated, online, target, now


@given(seed=st.integers(0, 1000))
def test_dqn_bootstraps_from_the_target_network_s_best_action(seed: int) -> None:
    rewards, terminated, online, target, _ = _batch(seed)
    targets = DQN(_GAMMA).targets(rewards, torch.arange(9), terminated, lambda s: online[s], lambda s: target[s])
    for b in range(9):
        expected = float(rewards[b])
        if not terminated[b]:
            expected += _GAMMA * max(float(q) for q in target[b])
        assert targets[b].item() == pytest.approx(expected, rel=1e-5, abs=1e-5)


@given(seed=st.integers(0, 1000))
def test_double_dqn_values_the_online_network_s_best_action_by_the_target_network(seed: int) -> None:
    rewards, terminated, online, target, _ = _batch(seed)
    targets = DoubleDQN(_GAMMA).targets(rewards, torch.arange(9), terminated, lambda s: online[s], lambda s: target[s])
    for b in range(9):
        expected = float(rewards[b])
        if not terminated[b]:
            best = max(range(4), key=lambda action: float(online[b, action]))
            expected += _GAMMA * float(target[b, best])
        assert targets[b].item() == pytest.approx(expected, rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("objective", [DQN(_GAMMA), DoubleDQN(_GAMMA)])
def test_nothing_comes_through_a_cut_bootstrap(objective: DQN | DoubleDQN) -> None:
    wild = torch.full((2, 4), torch.inf)
    targets = objective.targets(torch.tensor([1.0, 2.0]), wild, torch.tensor([True, False]), lambda s: s, lambda s: -s)
    assert targets.tolist() == [1.0, -torch.inf]


@given(seed=st.integers(0, 1000))
def test_the_loss_is_huber_s_of_the_taken_action(seed: int) -> None:
    rewards, _, _, _, q_BA = _batch(seed)
    actions = torch.from_numpy(np.random.default_rng(seed).integers(0, 4, 9))
    for objective in (DQN(_GAMMA), DoubleDQN(_GAMMA)):
        losses = objective.losses(q_BA, actions, rewards)
        assert losses.shape == (9,)
        for b in range(9):
            error = abs(float(q_BA[b, int(actions[b])]) - float(rewards[b]))
            expected = error * error / 2 if error < 1 else error - 0.5
            assert losses[b].item() == pytest.approx(expected, rel=1e-5, abs=1e-6)
