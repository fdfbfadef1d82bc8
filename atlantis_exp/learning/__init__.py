"""Learning: from batches of transitions to better action values.

In: networks, an optimizer, numpy batches of transitions. Out: action values, means of measurements, state dicts.
It must not know where transitions come from, which network it trains, or who watches.
"""
