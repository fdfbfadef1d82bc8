"""The work on runs: train, sweep, search, evaluate, compare, export, publish, show.

In: a checked config and the user's wishes, as a `Job`. Out: run folders, lines for a person, an exit code. It knows no
Hydra and no command line: typed words arrive as values.
"""
