"""The training: built emulators, actor, memory and learner enter; a journal, checkpoints and an outcome leave.

The only wing that has seen game, replay and learning together. Knows no config, no Hydra and no MLflow.
"""
