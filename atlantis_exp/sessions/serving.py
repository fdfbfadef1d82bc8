"""The MLflow UI on the local store."""

import os
import socket
import sys
from pathlib import Path

from atlantis_exp import terminal
from atlantis_exp.config import PathsConfig
from atlantis_exp.faults import Fault
from atlantis_exp.tracking.store import Store, first_line
from atlantis_exp.tracking.views import COMPARISONS, START, address


def serve(*, port: int, paths: PathsConfig) -> None:
    """Serve the store on 127.0.0.1 until interrupted; prints the address that shows the runs."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the server will: a port just left is free
        try:
            probe.bind(("127.0.0.1", port))
        except OSError as error:
            raise Fault(f"port={port}: {error.strerror}; choose another, as in port=5001") from None
    store = Store(Path(paths.outputs))
    try:
        with terminal.working("preparing MLflow's store"):
            store.prepare()
    except (Fault, OSError):
        raise
    except Exception as error:  # MLflow's and the database's own
        reason = first_line(error)
        raise Fault(f"{store.uri} cannot be opened: {reason}; without that file sync makes it again") from None
    for what, view in (("comparisons", COMPARISONS), ("MLflow UI", START)):
        print(f"{what}: {address(f'http://127.0.0.1:{port}', store.experiment_id, view)}", flush=True)
    os.environ["MLFLOW_SERVER_ENABLE_JOB_EXECUTION"] = "false"  # ten processes otherwise
    arguments = ["server", "--host", "127.0.0.1", "--port", str(port), "--workers", "1"]
    os.execv(sys.executable, [sys.executable, "-m", "mlflow", *arguments, "--backend-store-uri", store.uri])
