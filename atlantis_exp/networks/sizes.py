"""Compute sizes: feature maps, parameters."""

import copy

import torch
from torch import nn


def count_features(layers: nn.Module, input_shape: tuple[int, int, int]) -> int:
    """Return how many numbers layers make of an input (C, H, W); change nothing. Raises: RuntimeError if too small."""
    made: torch.Tensor = copy.deepcopy(layers).to("meta").eval()(torch.empty(1, *input_shape, device="meta"))
    return made.numel()


def count_parameters(network: nn.Module) -> int:
    """Return the number of a network's parameters, without running statistics."""
    return sum(parameter.numel() for parameter in network.parameters())
