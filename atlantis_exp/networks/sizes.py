"""Sizes: least inputs, feature maps after a convolution, parameters."""

from torch import nn


def check_sides(network: str, smallest: int, height: int, width: int) -> None:
    """Raise ValueError if a side of a network's input, in pixels, is below the smallest."""
    if min(height, width) < smallest:
        raise ValueError(f"{network} needs {smallest} pixels a side at least, not {height}x{width}")


def convolved(side: int, kernel: int, stride: int, padding: int = 0) -> int:
    """Return the side of the feature map after a convolution of an input of this side, both in pixels."""
    return (side + 2 * padding - kernel) // stride + 1


def count_parameters(network: nn.Module) -> int:
    """Return the number of learned values of a network; running statistics are not counted."""
    return sum(parameter.numel() for parameter in network.parameters())
