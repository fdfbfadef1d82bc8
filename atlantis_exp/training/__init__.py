"""The training loop, and what evaluates, records and continues it.

In: built emulators, actor, memory and learner. Out: a journal, checkpoints, an outcome. The only wing that has seen
game, replay and learning together. It must not know config, Hydra or MLflow.
"""
