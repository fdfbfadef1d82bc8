"""Run the training loop, and evaluate, record and checkpoint it.

In: built emulators, actor, memory and learner. Out: a journal, checkpoints, an outcome. Only this package combines
game, replay and learning. It must not know config, Hydra or MLflow.
"""
