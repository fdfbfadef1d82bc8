"""Dropout with its own random generator."""

import torch
from torch import nn


class Dropout(nn.Dropout):
    """Dropout that draws its masks from `generator`, never from torch's global one.

    The learner saves and restores the generator's state, which is not in the `state_dict` of weights.
    """

    def __init__(self, p: float) -> None:
        super().__init__(p)
        self.generator = torch.Generator()

    def forward(self, input: torch.Tensor) -> torch.Tensor:
        if not self.training:
            return input
        kept = torch.rand(input.shape, generator=self.generator, device=input.device) >= self.p
        return input * kept / (1 - self.p)


def seed_dropout(network: nn.Module, seed: int) -> None:
    """Give all dropout layers of a network one seeded generator; call it when the network is on its final device."""
    generator = torch.Generator(next(network.parameters()).device).manual_seed(seed)
    for module in network.modules():
        if isinstance(module, Dropout):
            module.generator = generator
