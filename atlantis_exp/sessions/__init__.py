"""What is done with runs: trained, swept, searched, evaluated, exported, verified, sent and shown.

In: a checked config and what was asked for, as a `Job`. Out: run folders, lines for a person, an exit code. It knows
no Hydra and no command line: what was typed arrives as values.
"""
