"""One module a verb: overrides enter, a checked config is composed, built and called.

Hydra and OmegaConf live here and nowhere else; what a verb does lives on the floors below.
"""
