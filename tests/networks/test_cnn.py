import pytest
import torch

from atlantis_exp.networks.cnn import DQNCnn
from atlantis_exp.networks.sizes import count_parameters


def test_the_layers_are_those_of_figure_2_1() -> None:
    network = DQNCnn((4, 84, 84), 4)
    assert [str(layer) for layer in [*network.features, *network.fc]] == [
        "Conv2d(4, 32, kernel_size=(8, 8), stride=(4, 4))",
        "ReLU()",
        "Conv2d(32, 64, kernel_size=(4, 4), stride=(2, 2))",
        "ReLU()",
        "Conv2d(64, 64, kernel_size=(3, 3), stride=(1, 1))",
        "Flatten(start_dim=1, end_dim=-1)",
        "ReLU()",
        "Linear(in_features=3136, out_features=512, bias=True)",
        "ReLU()",
        "Linear(in_features=512, out_features=4, bias=True)",
    ]


def test_it_has_as_many_parameters_as_its_layers_add_up_to() -> None:
    # (4*8*8+1)*32 + (32*4*4+1)*64 + (64*3*3+1)*64 + (3136+1)*512 + (512+1)*4
    assert count_parameters(DQNCnn((4, 84, 84), 4)) == 8_224 + 32_832 + 36_928 + 1_606_144 + 2_052 == 1_686_180


def test_it_computes_the_composition_of_its_layers() -> None:
    network = DQNCnn((4, 84, 84), 4)
    w = list(network.parameters())
    x = torch.rand(2, 4, 84, 84)
    y = torch.conv2d(x, w[0], w[1], stride=4).clamp(min=0)
    y = torch.conv2d(y, w[2], w[3], stride=2).clamp(min=0)
    y = torch.conv2d(y, w[4], w[5]).clamp(min=0)
    y = (y.reshape(2, 3136) @ w[6].T + w[7]).clamp(min=0) @ w[8].T + w[9]
    torch.testing.assert_close(network(x), y, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("height", "width"), [(36, 36), (36, 61), (100, 40)])
def test_it_takes_other_sizes_down_to_the_smallest(height: int, width: int) -> None:
    assert DQNCnn((3, height, width), 6)(torch.zeros(2, 3, height, width)).shape == (2, 6)
