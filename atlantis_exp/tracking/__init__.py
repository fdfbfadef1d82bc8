"""Metrics, images and weights enter; a run folder that tells its own story, and an MLflow run that mirrors it, leave.

Knows nothing of games, networks or configs: names and numbers only. MLflow is imported by `store` alone, on first use.
"""
