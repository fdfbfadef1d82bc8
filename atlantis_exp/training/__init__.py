"""The training loop, and its evaluation, records and checkpoints.

In: built emulators, actor, memory and learner. Out: a journal, checkpoints, an outcome. The only package that combines
game, replay and learning. It must not know config, Hydra or MLflow.
"""
