import pytest
import torch

from atlantis_exp.networks.cnn_small import SmallCnn
from atlantis_exp.networks.sizes import count_parameters


def test_the_layers_are_those_of_section_4_1() -> None:
    network = SmallCnn((4, 84, 84), 4)
    assert [str(layer) for layer in [*network.features, *network.fc]] == [
        "Conv2d(4, 16, kernel_size=(8, 8), stride=(4, 4))",
        "ReLU()",
        "Conv2d(16, 32, kernel_size=(4, 4), stride=(2, 2))",
        "ReLU()",
        "Linear(in_features=2592, out_features=256, bias=True)",
        "ReLU()",
        "Linear(in_features=256, out_features=4, bias=True)",
    ]
    assert count_parameters(network) == 4_112 + 8_224 + 663_808 + 1_028 == 677_172


@pytest.mark.parametrize(("height", "width"), [(20, 20), (21, 61), (100, 40)])
def test_it_takes_other_sizes_down_to_the_smallest(height: int, width: int) -> None:
    assert SmallCnn((3, height, width), 6)(torch.zeros(2, 3, height, width)).shape == (2, 6)
