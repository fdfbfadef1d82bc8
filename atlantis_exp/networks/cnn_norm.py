"""The network of the DQN paper with layer normalization."""

import torch
from torch import nn

from atlantis_exp.networks.cnn import DQNCnn
from atlantis_exp.networks.heads import Head


class NormedCnn(DQNCnn):
    """DQNCnn with a layer normalization before each ReLU, over all channels and pixels (PQN, Gallici et al. 2024).

    Maps (B, C, H, W) in [0, 1] to the output of `head`, as DQNCnn.
    """

    def __init__(self, input_shape: tuple[int, int, int], num_actions: int, head: Head = nn.Linear) -> None:
        super().__init__(input_shape, num_actions, head)
        x, layers = torch.zeros(1, *input_shape), list[nn.Module]()
        for layer in (*self.features, *self.fc):
            if isinstance(layer, nn.ReLU):
                layers.append(nn.LayerNorm(x.shape[1:]))
            layers.append(layer)
            x = layer(x)
        self.features, self.fc = nn.Sequential(*layers[:10]), nn.Sequential(*layers[10:])
