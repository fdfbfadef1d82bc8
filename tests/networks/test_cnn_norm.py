import torch
import torch.nn.functional as F

from atlantis_exp.networks.cnn import DQNCnn
from atlantis_exp.networks.cnn_norm import NormedCnn
from atlantis_exp.networks.sizes import count_parameters


def test_it_is_dqncnn_with_each_relu_of_normalized_values() -> None:
    torch.manual_seed(0)
    plain = DQNCnn((4, 84, 84), 4)
    torch.manual_seed(0)
    normed = NormedCnn((4, 84, 84), 4)
    assert count_parameters(normed) == count_parameters(plain) + 2 * (32 * 20 * 20 + 64 * 9 * 9 + 64 * 7 * 7 + 512)
    layers = [layer for layer in (*plain.features, *plain.fc) if count_parameters(layer)]
    x = states = torch.rand(3, 4, 84, 84)
    for layer in layers[:-1]:
        x = layer(x.flatten(1) if isinstance(layer, torch.nn.Linear) else x)
        mean, variance = x.flatten(1).mean(1), x.flatten(1).var(1, correction=0)
        shape = (3, *[1] * (x.dim() - 1))
        x = F.relu((x - mean.view(shape)) / torch.sqrt(variance.view(shape) + 1e-5))
    torch.testing.assert_close(normed(states), layers[-1](x))
