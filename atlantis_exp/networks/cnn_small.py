"""The network of the first DQN paper."""

import torch
from torch import nn

from atlantis_exp.networks.heads import Head
from atlantis_exp.networks.sizes import shapes_of


class SmallCnn(nn.Module):
    """Two convolutions and one hidden layer (Mnih et al. 2013, section 4.1): three tenths of DQNCnn's FLOPs at 84x84.

    Maps (B, C, H, W) in [0, 1] to the output of `head`, (B, num_actions) by default. `input_shape` = (C, H, W) sizes
    the first dense layer.
    """

    smallest_side = 20  # pixels: 20 -> 4 -> 1
    splits_batches = True

    def __init__(self, input_shape: tuple[int, int, int], num_actions: int, head: Head = nn.Linear) -> None:
        super().__init__()
        self.features = nn.Sequential(  # 84x84
            nn.Conv2d(input_shape[0], 16, kernel_size=8, stride=4),  # 20x20
            nn.ReLU(),
            nn.Conv2d(16, 32, kernel_size=4, stride=2),  # 9x9
            nn.ReLU(),
        )
        self.fc = nn.Sequential(
            nn.Linear(shapes_of(self.features, input_shape)[-1].numel(), 256),
            nn.ReLU(),
            head(256, num_actions),
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        q: torch.Tensor = self.fc(self.features(x).flatten(1))
        return q
