"""Compute sizes: smallest inputs, feature maps, parameters."""

from torch import nn


def check_sides(network: str, smallest: int, height: int, width: int) -> None:
    """Raise ValueError if a side of a network's input is below the smallest, in pixels."""
    if min(height, width) < smallest:
        raise ValueError(f"{network} needs at least {smallest} pixels a side, not {height}x{width}")


def convolved(side: int, kernel: int, stride: int) -> int:
    """Return the side of a convolution's feature map from the side of its input, in pixels."""
    return (side - kernel) // stride + 1


def count_parameters(network: nn.Module) -> int:
    """Return the number of a network's parameters, without running statistics."""
    return sum(parameter.numel() for parameter in network.parameters())
