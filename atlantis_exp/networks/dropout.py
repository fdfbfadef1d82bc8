"""Dropout with an owner for its randomness."""

import torch
from torch import nn


class Dropout(nn.Dropout):
    """Dropout that draws its masks from `generator` and never from torch's global one; in eval mode the identity.

    The generator is not in the `state_dict` of weights: the learner saves and restores its state.
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
    """Give all dropout layers of a network one common generator, on the network's device, with this seed.

    Call it once the network is on the device where it stays.
    """
    generator = torch.Generator(next(network.parameters()).device).manual_seed(seed)
    for module in network.modules():
        if isinstance(module, Dropout):
            module.generator = generator
