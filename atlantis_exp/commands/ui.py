"""`python -m atlantis_exp ui`: the MLflow UI on the local store."""

import os
import sys
from pathlib import Path

from atlantis_exp.commands.app import run_verb
from atlantis_exp.config import UiConfig


def ui(config: UiConfig) -> None:
    """Serve the store on 127.0.0.1 until interrupted; prints the address that shows the runs."""
    from atlantis_exp.tracking.store import Store

    store = Store(Path(config.paths.outputs))
    address = f"http://127.0.0.1:{config.port}/#/experiments/{store.experiment_id}/runs"
    print(f"MLflow UI: {address}?workflowType=machine_learning&compareRunsMode=CHART", flush=True)
    os.environ["MLFLOW_SERVER_ENABLE_JOB_EXECUTION"] = "false"  # ten processes otherwise
    arguments = ["server", "--host", "127.0.0.1", "--port", str(config.port), "--workers", "1"]
    os.execv(sys.executable, [sys.executable, "-m", "mlflow", *arguments, "--backend-store-uri", store.uri])


def main() -> None:
    """Compose and serve."""
    run_verb("ui", UiConfig, ui)
