import torch
from torch import nn

from atlantis_exp.networks.sizes import count_parameters, shapes_of


def test_shapes_are_found_without_a_trace_in_the_layers_or_in_random_numbers() -> None:
    layers = nn.Sequential(nn.Conv2d(2, 3, 3, stride=2), nn.BatchNorm2d(3), nn.ReLU(inplace=True)).train()
    before = {name: value.clone() for name, value in layers.state_dict().items()}
    chance = torch.get_rng_state()
    assert shapes_of(layers, (2, 11, 8)) == 3 * [(3, 5, 3)]
    assert torch.equal(torch.get_rng_state(), chance)
    layers.load_state_dict(before)
    with torch.device("meta"):
        assert shapes_of(layers, (2, 11, 8))[-1] == layers(torch.zeros(1, 2, 11, 8, device="cpu"))[0].shape
    layers.load_state_dict(before)
    shapes_of(layers, (2, 11, 8))
    assert layers.training
    for name, value in layers.state_dict().items():
        assert torch.equal(value, before[name])


def test_running_statistics_are_no_parameters() -> None:
    assert count_parameters(nn.Sequential(nn.Linear(3, 5), nn.BatchNorm1d(5))) == (3 * 5 + 5) + (5 + 5)
