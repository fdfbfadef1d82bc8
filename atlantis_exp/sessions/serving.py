"""Serve the MLflow UI on the local store."""

import socket
from contextlib import suppress
from pathlib import Path

from atlantis_exp import terminal
from atlantis_exp.config import PathsConfig
from atlantis_exp.faults import Fault
from atlantis_exp.sessions.syncing import publish_all
from atlantis_exp.tracking.publishing import lacking
from atlantis_exp.tracking.store import Store
from atlantis_exp.tracking.views import COMPARISONS, START, address, site


def serve(*, port: int, paths: PathsConfig) -> None:
    """Publish the runs that the store lacks, print its addresses, and serve it on 127.0.0.1 until interrupted."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the server will: a port just released is free
        try:
            probe.bind(("127.0.0.1", port))
        except OSError as error:
            raise Fault(f"port={port}: {error.strerror}; choose another, as in port=5001") from None
    outputs = Path(paths.outputs)
    store = Store(outputs)
    if missing := lacking(outputs):
        with suppress(Fault):  # a warning names each run that fails
            publish_all(outputs, store, missing)
    try:
        with terminal.working("preparing MLflow's store"):
            store.prepare()
            pages = site(outputs, address("", store.experiment_id, START))
    except OSError:
        raise
    except Exception as error:
        raise store.explained(error) from None
    here = f"http://127.0.0.1:{port}"
    print(f"comparisons: {address(here, store.experiment_id, COMPARISONS)}\nMLflow UI: {here}", flush=True)
    import uvicorn

    with suppress(KeyboardInterrupt):
        uvicorn.run(pages, host="127.0.0.1", port=port, log_level="warning", timeout_graceful_shutdown=2)
