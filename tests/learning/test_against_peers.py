"""The same tensors through well-kept libraries and through ours (extra `peers`)."""

import copy

import numpy as np
import pytest
import torch
from torch import nn

from atlantis_exp.learning.learner import Learner
from atlantis_exp.learning.objectives import DQN, DoubleDQN, Quantile
from atlantis_exp.replay.memory import ReplayMemory, Returns

GAMMA = 0.9


@pytest.mark.filterwarnings("ignore:No target network updater")
@pytest.mark.parametrize("objective", [DQN(), DoubleDQN()], ids=["dqn", "double_dqn"])
@pytest.mark.parametrize("seed", range(3))
def test_an_update_has_torchrl_s_loss_gradients_and_errors(objective: DQN, seed: int) -> None:
    """Both mean the smooth L1 loss over the batch; TorchRL's errors are squared."""
    pytest.importorskip("torchrl", reason="torchrl: extra `peers`")
    from tensordict import TensorDict
    from torchrl.modules import QValueActor
    from torchrl.objectives import DQNLoss, ValueEstimators

    rng = np.random.default_rng(seed)
    s_t, s_tpm = rng.integers(0, 256, (2, 12, 4, 3, 3), dtype=np.uint8)
    a_t, r_t = rng.integers(0, 4, 12), rng.choice([0.0, 0.3, 1.0, 100.0], 12).astype(np.float32)
    terminated = rng.random(12) < 0.3
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network, target = (nn.Sequential(nn.Flatten(), nn.Linear(36, 8), nn.ReLU(), nn.Linear(8, 4)) for _ in range(2))

    theirs = copy.deepcopy(target)
    peer = DQNLoss(
        QValueActor(theirs, in_keys=["observation"], action_space="categorical"),
        loss_function="smooth_l1",
        delay_value=True,
        double_dqn=isinstance(objective, DoubleDQN),
        action_space="categorical",
    )
    peer.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
    theirs.load_state_dict(network.state_dict())  # its target network stays what it was built with
    end = torch.from_numpy(terminated)[:, None]
    batch = TensorDict(
        {
            "observation": torch.from_numpy(s_t) / 255,
            "action": torch.from_numpy(a_t),
            "next": {
                "observation": torch.from_numpy(s_tpm) / 255,
                "reward": torch.from_numpy(r_t)[:, None],
                "terminated": end,
                "done": end,
            },
        },
        batch_size=[12],
    )
    loss = peer(batch)["loss"]
    loss.backward()

    learner = Learner(network, target, torch.optim.SGD(network.parameters(), lr=0.0), objective, 1.0)
    errors = learner.update(s_t, a_t, r_t, s_tpm, np.where(terminated, 0.0, GAMMA))
    assert learner.statistics()["loss"] == pytest.approx(loss.item(), rel=1e-5)
    torch.testing.assert_close(errors.square(), batch["td_error"].flatten(), rtol=1e-4, atol=1e-6)
    for ours, other in zip(network.parameters(), theirs.parameters(), strict=True):
        torch.testing.assert_close(ours.grad, other.grad)


@pytest.mark.parametrize("quantiles", [1, 5, 51])
def test_the_quantile_loss_is_sb3_contrib_s_sum_over_quantiles(quantiles: int) -> None:
    """Of its two conventions the paper's: a sum over the quantiles, a mean over the target's and over the batch."""
    common = pytest.importorskip("sb3_contrib.common.utils", reason="sb3-contrib: extra `peers`")
    rng = np.random.default_rng(quantiles)
    z_BAN = torch.from_numpy(rng.normal(0, 2, (9, 4, quantiles)).astype(np.float32)).requires_grad_()
    target_BN = torch.from_numpy(rng.normal(0, 2, (9, quantiles)).astype(np.float32))
    actions = torch.arange(9) % 4
    theirs = common.quantile_huber_loss(z_BAN[torch.arange(9), actions], target_BN, sum_over_quantiles=True)
    ours = Quantile(quantiles).losses(z_BAN, actions, target_BN).mean()
    torch.testing.assert_close(ours, theirs)
    torch.testing.assert_close(*(torch.autograd.grad(loss, z_BAN)[0] for loss in (ours, theirs)))


@pytest.mark.parametrize("n_step", [2, 3, 5])
def test_returns_over_n_steps_are_torchrl_s(n_step: int) -> None:
    """Rewards, the state after them and its distance. `MultiStep` leaves `terminated` as it was a step after s_t: where
    the bootstrap is cut follows here from the state reached."""
    postprocs = pytest.importorskip("torchrl.data.postprocs", reason="torchrl: extra `peers`")
    from tensordict import TensorDict

    length, rng = 60, np.random.default_rng(n_step)
    rewards = rng.choice([0.0, 1.0, 100.0], length).astype(np.float32)
    terminated, truncated = rng.random(length) < 0.1, rng.random(length) < 0.1
    truncated &= ~terminated
    done = terminated | truncated
    memory = ReplayMemory(2 * length, (2, 2), lags=[0], budget_bytes=1 << 20)
    # An episode's first observation is 2k, the one after step k is 2k + 1.
    before = np.where(np.insert(done[:-1], 0, True), 2 * np.arange(length), 2 * np.arange(length) - 1)
    after = 2 * np.arange(length) + 1
    ids = []
    for step in range(length):
        if before[step] == 2 * step:
            memory.begin(0, np.full((2, 2), before[step], np.uint8))
        ids.append(memory.next_id - 1)
        memory.add(0, 0, rewards[step], np.full((2, 2), after[step], np.uint8), bool(terminated[step]))
    ours = memory.gather(np.array(ids), Returns(GAMMA, n_step))

    steps = {"reward": rewards, "terminated": terminated, "truncated": truncated, "done": done, "observation": after}
    theirs = postprocs.MultiStep(gamma=GAMMA, n_steps=n_step)(
        TensorDict({"next": {key: torch.as_tensor(value)[None, :, None] for key, value in steps.items()}}, [1, length])
    ).view(-1)
    np.testing.assert_allclose(ours.r_t, theirs["next", "reward"].flatten(), rtol=1e-5)
    np.testing.assert_array_equal(ours.s_t[:, 0, 0, 0], before)
    reached = theirs["next", "observation"].flatten().numpy()
    np.testing.assert_array_equal(ours.s_tpm[:, 0, 0, 0], reached)
    np.testing.assert_allclose(ours.discount, np.where(terminated[reached // 2], 0.0, theirs["gamma"]), rtol=1e-5)
