"""Names and facts that are needed before torch and numpy are there."""

SMALLEST_SIDE = {
    "cnn": 36,  # 36 -> 8 -> 3 -> 1
    "resnet": 15,  # 15 -> 7 -> 5 -> 3 -> 1
    "resnet_fast": 8,  # 8 -> 1
}
"""The pixels a side that a network's unpadded convolutions need."""

SOURCES = ("centre_vessel", "side_vessel", "centre_bomber", "side_bomber", "wave_bonus")
"""What pays points in Atlantis.

A vessel pays 100 and a bomber 1,000 where the centre gun hits it, twice as much where a side gun does; the end of a
wave pays 500 for each building that stands, in one frame.
"""

TABLE_COLUMNS = ("mean", "standard_error", "median", "interquartile_mean", "high", "low")
"""The parts of a score distribution's summary that a line of a table has, in their order."""
