"""Compute sizes: feature maps, parameters."""

import copy
from collections.abc import Iterable

import torch
from torch import nn


@torch.no_grad()
def shapes_of(layers: Iterable[nn.Module], input_shape: tuple[int, int, int]) -> list[torch.Size]:
    """Return the shape that each layer in turn makes of an input (C, H, W); change nothing.

    Raises: RuntimeError if the input is too small.
    """
    # Not on the device "meta", whose first convolution imports for a second.
    x, shapes = torch.zeros(1, *input_shape, device="cpu"), []
    for layer in layers:
        x = copy.deepcopy(layer).to_empty(device="cpu").eval()(x)
        shapes.append(x.shape[1:])
    return shapes


def count_parameters(network: nn.Module) -> int:
    """Return the number of a network's parameters, without running statistics."""
    return sum(parameter.numel() for parameter in network.parameters())
