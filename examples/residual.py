"""A network: two small residual blocks after a stem that shrinks the screen."""

from typing import Annotated

import torch
from annotated_types import Interval
from torch import nn

from atlantis_exp.components import component
from atlantis_exp.networks.heads import Head

Width = Annotated[int, Interval(ge=4, le=256)]


class Block(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.residual = nn.Sequential(nn.ReLU(), nn.Conv2d(width, width, 3, padding=1), nn.ReLU())

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y: torch.Tensor = x + self.residual(x)
        return y


@component("residual", "model")
class ResidualNetwork(nn.Module):
    smallest_side = 8  # pixels
    splits_batches = True  # no batch statistics, no dropout

    def __init__(self, input_shape: tuple[int, int, int], num_actions: int, head: Head, width: Width = 32) -> None:
        super().__init__()
        channels, *_ = input_shape
        stem = nn.Conv2d(channels, width, kernel_size=8, stride=4)
        self.features = nn.Sequential(stem, Block(width), Block(width), nn.AdaptiveMaxPool2d(4), nn.Flatten())
        self.head = head(16 * width, num_actions)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        q: torch.Tensor = self.head(self.features(x))
        return q
