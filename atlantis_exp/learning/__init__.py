"""Learn action values from batches of transitions.

In: networks, an optimizer, numpy batches of transitions. Out: action values, means of measurements, state dicts.
The package must not know where transitions come from, which network it trains, or who watches.
"""
