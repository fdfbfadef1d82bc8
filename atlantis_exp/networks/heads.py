"""Map a network's features to action values or their quantiles, by its last layer."""

from collections.abc import Callable
from typing import TypeAlias

import torch
from torch import nn

Head: TypeAlias = Callable[[int, int], nn.Module]
"""Makes the last layer for a number of features and of actions; the plain one is `nn.Linear`."""


class QuantileHead(nn.Module):
    """N quantiles of the return of each action (Dabney et al. 2018).

    Maps (B, features) to (B, num_actions, N).
    """

    def __init__(self, features: int, num_actions: int, quantiles: int) -> None:
        super().__init__()
        self.shape = (num_actions, quantiles)
        self.linear = nn.Linear(features, num_actions * quantiles)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        z_BAN: torch.Tensor = self.linear(x).unflatten(1, self.shape)
        return z_BAN


class DuelingHead(nn.Module):
    """A state's value plus each action's advantage, whose mean is 0 (Wang et al. 2016, equation 9).

    Maps (B, features) to (B, num_actions). Each half of the features is one of the paper's two streams, so a dueling
    network is as large as a plain one: the streams of DQNCnn have 256 units each, the paper's 512.
    """

    def __init__(self, features: int, num_actions: int) -> None:
        super().__init__()
        self.value = nn.Linear(features // 2, 1)
        self.advantage = nn.Linear(features - features // 2, num_actions)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        value_B1 = self.value(x[:, : self.value.in_features])
        advantage_BA = self.advantage(x[:, self.value.in_features :])
        q_BA: torch.Tensor = value_B1 + advantage_BA - advantage_BA.mean(1, keepdim=True)
        return q_BA
