import pytest
import torch
from torch import nn

from atlantis_exp.networks.cnn import DQNCnn
from atlantis_exp.networks.heads import DuelingHead, Head, QuantileHead
from atlantis_exp.networks.resnet import ResNetDQN
from atlantis_exp.networks.resnet_fast import ResNetFast
from atlantis_exp.networks.sizes import count_parameters


def quantile_head(features: int, num_actions: int) -> QuantileHead:
    return QuantileHead(features, num_actions, 7)


@pytest.mark.parametrize("network_class", [DQNCnn, ResNetDQN, ResNetFast])
@pytest.mark.parametrize(
    ("head", "shape"),
    [(nn.Linear, (2, 4)), (DuelingHead, (2, 4)), (quantile_head, (2, 4, 7))],
    ids=["plain", "dueling", "quantile"],
)
def test_every_network_takes_every_head(network_class: type[nn.Module], head: Head, shape: tuple[int, ...]) -> None:
    assert network_class((4, 36, 36), 4, head)(torch.zeros(2, 4, 36, 36)).shape == shape


def test_a_quantile_head_is_one_dense_layer_action_by_action() -> None:
    head, x = QuantileHead(6, 4, 3), torch.rand(2, 6)
    z_BAN = head(x)
    for action in range(4):
        for quantile in range(3):
            row = 3 * action + quantile
            expected = x @ head.linear.weight[row] + head.linear.bias[row]
            torch.testing.assert_close(z_BAN[:, action, quantile], expected)


def test_dueling_values_are_the_state_s_plus_advantages_less_their_mean() -> None:
    head, x = DuelingHead(6, 4), torch.rand(2, 6)
    q_BA = head(x)
    for b in range(2):
        value = head.value.weight[0] @ x[b, :3] + head.value.bias[0]
        advantages = [head.advantage.weight[a] @ x[b, 3:] + head.advantage.bias[a] for a in range(4)]
        for a in range(4):
            torch.testing.assert_close(q_BA[b, a], value + advantages[a] - sum(advantages) / 4)


def test_a_dueling_network_is_as_large_as_a_plain_one_but_for_the_value() -> None:
    plain, dueling = DQNCnn((4, 84, 84), 4), DQNCnn((4, 84, 84), 4, DuelingHead)
    assert count_parameters(dueling) - count_parameters(plain) == (256 + 1) - 4 * 256
