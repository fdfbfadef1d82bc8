import pytest
import torch
from torch import nn
from torch.nn import functional as F

from atlantis_exp.networks.resnet import ResNetBlock, ResNetDQN
from atlantis_exp.networks.sizes import count_parameters


def test_the_stem_is_that_of_figure_2_2() -> None:
    assert [str(layer).split(", eps")[0] for layer in ResNetDQN((4, 159, 159), 4).block1] == [
        "Conv2d(4, 16, kernel_size=(3, 3), stride=(2, 2))",
        "SiLU(inplace=True)",
        "BatchNorm2d(16",
        "Conv2d(16, 32, kernel_size=(3, 3), stride=(1, 1))",
        "SiLU(inplace=True)",
        "BatchNorm2d(32",
        "Conv2d(32, 32, kernel_size=(3, 3), stride=(1, 1))",
        "SiLU(inplace=True)",
        "BatchNorm2d(32",
        "Conv2d(32, 32, kernel_size=(3, 3), stride=(2, 2))",
    ]


def test_the_dense_layers_are_those_of_figure_2_2() -> None:
    assert [str(layer) for layer in ResNetDQN((4, 159, 159), 4).regression] == [
        "Dropout(p=0.3, inplace=False)",
        "Linear(in_features=12800, out_features=1024, bias=True)",
        "Dropout(p=0.2, inplace=False)",
        "SiLU(inplace=True)",
        "Linear(in_features=1024, out_features=4, bias=True)",
    ]


def test_it_has_as_many_parameters_as_its_layers_add_up_to() -> None:
    # (fan in + bias) * out for convolutions and dense layers, 2 a channel for each normalisation
    stem = (4 * 9 + 1) * 16 + 2 * 16 + (16 * 9 + 1) * 32 + 2 * 32 + (32 * 9 + 1) * 32 + 2 * 32 + (32 * 9 + 1) * 32
    to_64 = 32 * 9 * 64 + 64 * 9 * 64 + 32 * 64 + 3 * 2 * 64  # the last conv term is the shortcut's
    at_64 = 2 * 64 * 9 * 64 + 2 * 2 * 64
    to_128 = 64 * 9 * 128 + 128 * 9 * 128 + 64 * 128 + 3 * 2 * 128
    at_128 = 2 * 128 * 9 * 128 + 2 * 2 * 128
    dense = (128 * 10 * 10 + 1) * 1024 + (1024 + 1) * 4
    assert stem + to_64 + 2 * at_64 + to_128 + at_128 + dense == 13_867_476
    assert count_parameters(ResNetDQN((4, 159, 159), 4)) == 13_867_476


def _normalised(x: torch.Tensor) -> torch.Tensor:
    mean = x.mean((0, 2, 3), keepdim=True)
    return (x - mean) / torch.sqrt(((x - mean) ** 2).mean((0, 2, 3), keepdim=True) + 1e-5)


@pytest.mark.parametrize("out_channels", [None, 6])
def test_a_block_adds_its_shortcut_before_the_last_activation(out_channels: int | None) -> None:
    block = ResNetBlock(3, nn.SiLU, out_channels)
    x = torch.randn(2, 3, 7, 7)
    weights = [m.weight for m in block.modules() if isinstance(m, nn.Conv2d)]
    stride = 1 if out_channels is None else 2
    y = F.silu(_normalised(torch.conv2d(x, weights[0], stride=stride, padding=1)))
    y = _normalised(torch.conv2d(y, weights[1], padding=1))
    shortcut = x if out_channels is None else _normalised(torch.conv2d(x, weights[2], stride=2))
    torch.testing.assert_close(block(x), F.silu(y + shortcut), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("height", "width"), [(15, 15), (15, 40), (64, 47)])
def test_it_takes_other_sizes_down_to_the_smallest(height: int, width: int) -> None:
    assert ResNetDQN((3, height, width), 6)(torch.zeros(2, 3, height, width)).shape == (2, 6)
