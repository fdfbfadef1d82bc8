"""The network of the DQN paper with layer normalization."""

from torch import nn

from atlantis_exp.networks.cnn import DQNCnn
from atlantis_exp.networks.heads import Head
from atlantis_exp.networks.sizes import shapes_of


class NormedCnn(DQNCnn):
    """DQNCnn with a layer normalization before each ReLU, over all channels and pixels (PQN, Gallici et al. 2024).

    Maps (B, C, H, W) in [0, 1] to the output of `head`, as DQNCnn.
    """

    def __init__(self, input_shape: tuple[int, int, int], num_actions: int, head: Head = nn.Linear) -> None:
        super().__init__(input_shape, num_actions, head)
        plain, layers = (*self.features, *self.fc), list[nn.Module]()
        for layer, shape in zip(plain, shapes_of(plain, input_shape), strict=True):
            layers += [nn.LayerNorm(shape), layer] if isinstance(layer, nn.ReLU) else [layer]
        end = layers.index(self.fc[0])
        self.features, self.fc = nn.Sequential(*layers[:end]), nn.Sequential(*layers[end:])
