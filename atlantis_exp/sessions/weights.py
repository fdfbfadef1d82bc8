"""The weights that a stored run has: of its last commit, or of its best evaluation."""

import safetensors.torch

from atlantis_exp.faults import Fault
from atlantis_exp.runs.folder import BEST_WEIGHTS, RunFolder
from atlantis_exp.runs.journal import Model, read
from atlantis_exp.training.checkpoint import CheckpointError, Checkpoints


def stored_weights(run: RunFolder, weights: str) -> tuple[bytes, int]:
    """A stored run's network as safetensors, and its step; weights: `latest` or `best`.

    A folder without checkpoints, as one that was brought from a server, has the weights of its evaluations.

    Raises:
        Fault: where the run has no such weights.
    """
    try:
        state = Checkpoints(run.checkpoints, run.trained_config.identity()).load()
    except CheckpointError as error:
        raise Fault(f"run {run.name}: {error}") from error
    if state is None:
        models = [record for _, record in read(run.path) if isinstance(record, Model)]
        stored = [model for model in models if weights == "latest" or model.best]
        if not stored:
            raise Fault(f"run {run.name} has neither a checkpoint nor an evaluation yet")
        return run.artifact(stored[-1].path).read_bytes(), stored[-1].step
    if weights == "latest":
        learner = state["learner"]
        return safetensors.torch.save(learner.get("evaluated", learner["network"])), int(state["counters"]["steps"])
    path = run.artifact(BEST_WEIGHTS)
    if not path.exists():
        raise Fault(f"run {run.name} has no evaluation yet, so no best weights; weights=latest has some")
    return path.read_bytes(), int(state["best_step"])
