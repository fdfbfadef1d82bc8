import pytest
import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from atlantis_exp.networks.resnet import ResNetDQN
from atlantis_exp.networks.resnet_fast import ResidualBlock, ResNetFast
from atlantis_exp.networks.sizes import count_parameters


def flops_of_an_update(network: nn.Module, target: nn.Module) -> int:
    """Of one sample: the network's pass forward and back, the target network's forward."""
    with FlopCounterMode(display=False) as counter:
        with torch.no_grad():
            target(torch.zeros(2, 4, 159, 159))
        network(torch.zeros(2, 4, 159, 159)).sum().backward()
    return int(counter.get_total_flops()) // 2


def test_it_costs_a_tenth_of_the_report_s() -> None:
    fast, report = (
        flops_of_an_update(make((4, 159, 159), 4), make((4, 159, 159), 4)) for make in (ResNetFast, ResNetDQN)
    )
    assert round(fast / 1e9, 2) == 0.20
    assert round(report / 1e9, 2) == 1.87


def test_its_weights_are_less_than_8_mb_in_half_precision() -> None:
    assert 2 * count_parameters(ResNetFast((4, 159, 159), 4)) < 7_000_000


def test_a_residual_block_that_adds_nothing_is_the_identity() -> None:
    block, x = ResidualBlock(8), torch.randn(2, 8, 5, 5)
    assert not torch.equal(block(x), x)
    nn.init.zeros_(block.residual[3].weight)  # type: ignore[arg-type]
    nn.init.zeros_(block.residual[3].bias)  # type: ignore[arg-type]
    assert torch.equal(block(x), x)


@pytest.mark.parametrize(("height", "width"), [(8, 8), (36, 61), (84, 84), (160, 80)])
def test_it_takes_other_sizes_down_to_the_smallest(height: int, width: int) -> None:
    assert ResNetFast((3, height, width), 6)(torch.zeros(2, 3, height, width)).shape == (2, 6)
