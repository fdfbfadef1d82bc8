"""`python -m atlantis_exp ui`: the MLflow UI on the local store."""

import os
import socket
import sys
from pathlib import Path

from atlantis_exp.commands.app import run_verb
from atlantis_exp.config import UiConfig
from atlantis_exp.faults import Fault


def ui(config: UiConfig) -> None:
    """Serve the store on 127.0.0.1 until interrupted; prints the address that shows the runs."""
    from atlantis_exp.tracking.store import Store
    from atlantis_exp.tracking.views import START, address

    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the server will: a port just left is free
        try:
            probe.bind(("127.0.0.1", config.port))
        except OSError as error:
            raise Fault(f"port={config.port}: {error.strerror}; choose another, as in port=5001") from None
    store = Store(Path(config.paths.outputs))
    store.prepare()
    print(f"MLflow UI: {address(f'http://127.0.0.1:{config.port}', store.experiment_id, START)}", flush=True)
    os.environ["MLFLOW_SERVER_ENABLE_JOB_EXECUTION"] = "false"  # ten processes otherwise
    arguments = ["server", "--host", "127.0.0.1", "--port", str(config.port), "--workers", "1"]
    os.execv(sys.executable, [sys.executable, "-m", "mlflow", *arguments, "--backend-store-uri", store.uri])


def main() -> None:
    """Compose and serve."""
    run_verb("ui", UiConfig, ui)
