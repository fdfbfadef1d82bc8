"""Names and facts that are needed before torch and numpy are there."""

SOURCES = ("centre_vessel", "side_vessel", "centre_bomber", "side_bomber", "wave_bonus")
"""What pays points in Atlantis.

A vessel pays 100 and a bomber 1,000 where the centre gun hits it, twice as much where a side gun does; the end of a
wave pays 500 for each building that stands, in one frame.
"""

TABLE_COLUMNS = ("mean", "standard_error", "median", "interquartile_mean", "high", "low")
"""The parts of a score distribution's summary that a line of a table has, in their order."""
