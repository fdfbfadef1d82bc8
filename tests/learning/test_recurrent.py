"""Sequences side by side against one sequence after the other, step by step."""

import copy
from functools import partial
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pytest
import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from atlantis_exp.learning.objectives import DQN, DoubleDQN, DoubleQuantile, Objective
from atlantis_exp.learning.recurrent import RecurrentLearner
from atlantis_exp.networks.cnn_gru import DQNCnnGru
from atlantis_exp.networks.heads import Head, QuantileHead

BURN_IN, UNROLL, AHEAD, SIDE = 2, 4, 3, 36
QUANTILE: Head = partial(QuantileHead, quantiles=5)
Batch = tuple[npt.NDArray[Any], ...]


def _learner(
    objective: Objective = DoubleDQN(),  # noqa: B008 - frozen
    head: Head = nn.Linear,
    burn_in: int = BURN_IN,
    **options: Any,
) -> RecurrentLearner:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network, target = (
            DQNCnnGru((2, SIDE, SIDE), 3, head, units=8, burn_in=burn_in, unroll=UNROLL) for _ in range(2)
        )
    optimizer = torch.optim.SGD(network.parameters(), lr=0.1)
    return RecurrentLearner(network, target, optimizer, objective, 0.5, ahead=AHEAD, **options)


def _batch(first: tuple[int, ...] = (0, 1, 2, 4, 5), last: tuple[int, ...] = (3, 5, 2, 5, 5)) -> Batch:
    rng, size = np.random.default_rng(0), len(first)
    m = rng.integers(1, AHEAD + 1, (size, UNROLL))
    return (
        rng.integers(0, 256, (size, BURN_IN + UNROLL + AHEAD, 2, SIDE, SIDE), np.uint8),
        np.array(first),
        np.array(last),
        rng.integers(0, 3, (size, UNROLL)),
        rng.random((size, UNROLL), np.float32),
        m,
        np.where(rng.random((size, UNROLL)) < 0.3, 0.0, 0.9**m).astype(np.float32),
    )


def _naive(learner: RecurrentLearner, weights: npt.NDArray[Any], batch: Batch) -> tuple[list[float], nn.Module]:
    """Take sequence by sequence, step by step; return the priorities, and the network with its gradients."""
    online, priorities = cast(DQNCnnGru, copy.deepcopy(learner.network)), []
    for states, first, last, a_t, r_t, m, discount, weight in zip(*batch, weights, strict=True):
        inside = range(max(BURN_IN, first), last + 1)

        def q_of(network: Any, learned: range, states: Any = states, first: int = first) -> list[torch.Tensor]:
            """Values of each state, none before the first, with gradients in the learned steps."""
            h, x, values = torch.zeros(1, 8), torch.from_numpy(states).float() / 255, [torch.empty(0)] * int(first)
            for t in range(first, len(x)):
                with torch.set_grad_enabled(t in learned):
                    h = network.core(network.fc(network.features(x[t : t + 1])), h)
                    values.append(network.head(h))
            return values

        there = [
            partial(lambda said, at: said[int(at)], q_of(network, range(0))) for network in (online, learner.target)
        ]
        q, errors, losses = q_of(online, inside), [], []
        for at in inside:
            step = at - BURN_IN
            reward, gamma = torch.tensor(r_t[step : step + 1]), torch.tensor(discount[step : step + 1])
            target = learner.objective.targets(reward, torch.tensor(at + m[step]), gamma, *there)
            losses.append(learner.objective.losses(q[at], torch.tensor(a_t[step : step + 1]), target))
            errors.append(abs(float((target - q[at][:, a_t[step]]).mean().detach())))
        (float(weight) * torch.cat(losses).sum() / UNROLL / len(weights)).backward()  # type: ignore[no-untyped-call]
        priorities.append(0.9 * max(errors) + 0.1 * sum(errors) / len(errors))
    return priorities, online


@pytest.mark.parametrize("shards", [1, 2])
@pytest.mark.parametrize(
    ("objective", "head"), [(DQN(), nn.Linear), (DoubleDQN(), nn.Linear), (DoubleQuantile(5), QUANTILE)]
)
def test_an_update_is_the_sum_over_sequences_stepped_one_after_the_other(
    objective: Objective, head: Head, shards: int
) -> None:
    learner, batch = _learner(objective, head, shards=shards), _batch()
    weights = np.linspace(0.2, 1.0, 5, dtype=np.float32)
    priorities, naive = _naive(learner, weights, batch)
    errors = learner.update(*batch, weights=weights)
    np.testing.assert_allclose(errors, priorities, rtol=1e-4)
    for ours, theirs in zip(learner.network.parameters(), naive.parameters(), strict=True):
        torch.testing.assert_close(ours.grad, theirs.grad, rtol=1e-3, atol=1e-7)


def test_what_fills_the_places_around_an_episode_changes_nothing() -> None:
    one, other, batch = _learner(), _learner(), _batch((3,), (4,))
    batch[5][:] = 1  # steps to the next state
    errors = one.update(*batch)
    for each in (*batch[3:5], batch[6]):
        each[:, [0, 3]] = 1 - each[:, [0, 3]]  # of steps 2 and 5
    batch[0][:, [0, 1, 2, 6, 7, 8]] = 7
    torch.testing.assert_close(other.update(*batch), errors, rtol=0, atol=0)
    torch.testing.assert_close(other.network.state_dict(), one.network.state_dict(), rtol=0, atol=0)


def test_acting_step_by_step_is_the_sequence_and_the_average_acts_by_its_own_weights() -> None:
    learner, states = _learner(ema=100), _batch()[0]
    for _ in range(20):
        learner.update(*_batch())
    for step, network in ((learner.step, learner.network), (learner.evaluated_step, learner.evaluated)):
        memory = np.zeros((5, 8), np.float32)
        with torch.no_grad():
            x = torch.from_numpy(states).float() / 255
            q, end = cast(DQNCnnGru, network).sequence(x, torch.from_numpy(memory), torch.full((5,), -1))
        for t in range(states.shape[1]):
            values, memory = step(states[:, t], memory)
            np.testing.assert_allclose(values, q[:, t], atol=1e-5)
        np.testing.assert_allclose(memory, end, atol=1e-5)
    assert not np.allclose(learner.step(states[:, 0], memory)[0], learner.evaluated_step(states[:, 0], memory)[0])


def test_flops_count_every_state_of_a_sequence_once_a_pass() -> None:
    learner = _learner(DQN())
    with FlopCounterMode(display=False) as counter:
        learner.update(*_batch())
    flops = counter.get_total_flops()
    assert _learner(DQN()).update_flops((2, SIDE, SIDE), 5) == flops
    network = cast(DQNCnnGru, _learner().network)
    with FlopCounterMode(display=False) as counter, torch.no_grad():  # of the choice of Double DQN, after the burn-in
        network.sequence(torch.zeros(5, UNROLL + AHEAD, 2, SIDE, SIDE), torch.zeros(5, 8), torch.zeros(5))
    assert _learner(DoubleDQN()).update_flops((2, SIDE, SIDE), 5) == flops + counter.get_total_flops()
    assert _learner(DQN(), burn_in=2 * UNROLL).update_flops((2, SIDE, SIDE), 5) > flops


def test_bfloat16_learns_and_remembers() -> None:
    learner, batch = _learner(precision="bf16"), _batch()
    before = copy.deepcopy(learner.network.state_dict())
    assert learner.update(*batch).isfinite().all()
    assert any(not torch.equal(each, before[name]) for name, each in learner.network.state_dict().items())
    assert learner.step(batch[0][:, 0], np.zeros((5, 8), np.float32))[1].dtype == np.float32
