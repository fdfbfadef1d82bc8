"""Read a stored run's weights: of its last commit, or of its best evaluation until then."""

from atlantis_exp.faults import Fault
from atlantis_exp.runs.files import ARTIFACT, is_whole, read_file
from atlantis_exp.runs.folder import NETWORK, RunFolder
from atlantis_exp.runs.journal import Model, model_file
from atlantis_exp.training.checkpoint import CheckpointError, Checkpoints, to_safetensors, unforged
from atlantis_exp.training.plan import Counters


def stored_weights(run: RunFolder, weights: str) -> tuple[bytes, int]:
    """Return a stored run's network as safetensors, and its step; weights: `latest` or `best`. Raises: Fault.

    A folder without checkpoints has the weights of its evaluations.
    """
    try:
        state = Checkpoints(run.checkpoints, run.trained_config.identity()).load()
    except CheckpointError as error:
        raise Fault(f"run {run.name}: {error}") from error
    if state is None:
        models = [record for record in run.records() if isinstance(record, Model)]
        stored = [model for model in models if weights == "latest" or model.best]
        if not stored:
            raise Fault(f"run {run.name} has neither a checkpoint nor an evaluation yet")
        return _read(run, stored[-1].path, stored[-1].sha256), stored[-1].step
    with unforged(run.checkpoints):
        if weights == "latest":
            learner = state["learner"]
            return to_safetensors(learner.get("evaluated", learner["network"])), Counters.of(state["counters"]).steps
        step = min(int(state["best_step"]), Counters.of(state["counters"]).steps)
    if step < 0:
        raise Fault(f"run {run.name} has no evaluation yet, so no best weights; use weights=latest")
    return _read(run, model_file(NETWORK, step), state.get("best_sha256", "")), step


def _read(run: RunFolder, path: str, sha256: str) -> bytes:
    """Read an artifact with weights. Raises: Fault."""
    try:
        content = read_file(file := run.artifact(path), ARTIFACT)
    except (OSError, ValueError) as error:
        raise Fault(f"run {run.name}: its weights cannot be read: {error}") from None
    if not is_whole(content, sha256):
        raise Fault(f"run {run.name}: {file} is damaged, or newer than the run's last commit")
    return content
