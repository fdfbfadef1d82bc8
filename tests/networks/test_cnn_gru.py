from functools import partial

import pytest
import torch
from torch import nn

from atlantis_exp.learning.values import Recurrent
from atlantis_exp.networks.cnn import DQNCnn
from atlantis_exp.networks.cnn_gru import DQNCnnGru
from atlantis_exp.networks.heads import DuelingHead, Head, QuantileHead
from atlantis_exp.networks.sizes import count_parameters


def _network(head: Head = nn.Linear) -> DQNCnnGru:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return DQNCnnGru((2, 36, 36), 4, head, units=16, burn_in=3, unroll=5)


def _states(*batch: int) -> torch.Tensor:
    return torch.rand(*batch, 2, 36, 36, generator=torch.Generator().manual_seed(0))


def _never(count: int) -> torch.Tensor:
    return torch.full((count,), -1)


def test_it_is_dqncnn_up_to_its_dense_layer_then_a_memory_and_the_head() -> None:
    network, cnn = DQNCnnGru((4, 84, 84), 4, units=512, burn_in=20, unroll=20), DQNCnn((4, 84, 84), 4)
    assert str(network.features) == str(cnn.features)
    assert str(network.fc[0]) == str(cnn.fc[0])
    assert str(network.core) == "GRUCell(512, 512)"
    assert count_parameters(network) == count_parameters(cnn) + 3 * (512 + 1 + 512 + 1) * 512
    assert isinstance(network, Recurrent)
    assert not isinstance(cnn, Recurrent)


@pytest.mark.parametrize(
    ("head", "shape"), [(nn.Linear, (4,)), (DuelingHead, (4,)), (partial(QuantileHead, quantiles=7), (4, 7))]
)
def test_a_sequence_is_its_steps_one_after_the_other(head: Head, shape: tuple[int, ...]) -> None:
    network, x, h = _network(head).eval(), _states(3, 6), torch.rand(3, 16)
    q, end = network.sequence(x, h, _never(3))
    assert q.shape == (3, 6, *shape)
    for t in range(6):
        q_t, h = network.sequence(x[:, t : t + 1], h, _never(3))
        torch.testing.assert_close(q_t[:, 0], q[:, t])
    torch.testing.assert_close(h, end)


def test_before_its_first_step_a_sequence_has_no_memory_and_a_state_alone_is_a_first_one() -> None:
    network, x = _network().eval(), _states(2, 6)
    q, end = network.sequence(x, torch.rand(2, 16), torch.tensor([3, 0]))
    for row, first in enumerate((3, 0)):
        alone, h = network.sequence(x[row : row + 1, first:], torch.zeros(1, 16), _never(1))
        torch.testing.assert_close(alone[0], q[row, first:])
        torch.testing.assert_close(h[0], end[row])
        torch.testing.assert_close(network(x[row, : first + 1]), q[row, : first + 1])
