"""Facts of components by name that are needed before torch is there."""

SMALLEST_SIDE = {
    "cnn": 36,  # 36 -> 8 -> 3 -> 1
    "resnet": 15,  # 15 -> 7 -> 5 -> 3 -> 1
    "resnet_fast": 8,  # 8 -> 1
}
"""The pixels a side that a network's unpadded convolutions need."""
