"""The work of the verbs: train, sweep, search, evaluate, compare, export, publish, show.

In: a checked config, for a training as a `Job`. Out: run folders, lines for a person, an exit code. It must know
neither Hydra nor the command line.
"""
