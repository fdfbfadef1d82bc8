"""Take the pictures of MLflow's pages in docs/tracking.md: `python docs/make_tracking_pictures.py OUTPUTS`.

OUTPUTS is a folder of runs whose store is published, with a sweep and a comparison. Needs playwright and a Chromium.
"""

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

from atlantis_exp.tracking.store import Store
from atlantis_exp.tracking.views import COMPARISONS, START, address

IMAGES = Path(__file__).parent / "images"
SECONDS = 8  # until a page's charts are drawn


def take(page: Page, place: str, name: str) -> None:
    """Open a place and write its picture."""
    page.goto("about:blank")  # else only the part after '#' changes, and the application keeps the old view
    page.goto(place)
    page.wait_for_timeout(1_000 * SECONDS)
    page.screenshot(path=IMAGES / f"mlflow_{name}.png")
    print(IMAGES / f"mlflow_{name}.png", flush=True)


def main() -> None:
    """Serve the store and take the pictures."""
    outputs = Path(sys.argv[1]).absolute()
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = (sys.executable, "-m", "atlantis_exp", "ui", f"port={port}", f"paths.outputs={outputs}")
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True)
    store, root = Store(outputs), f"http://127.0.0.1:{port}"
    kinds = {run.data.tags["atlantis.kind"]: run.info.run_id for run in store.runs()}
    places = {view: address(root, store.experiment_id, view) for view in (START, COMPARISONS)}
    runs = places[START].partition("?")[0]
    try:
        while server.poll() is None:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.5)
        with sync_playwright() as started:
            browser = started.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
            page = browser.new_page(viewport={"width": 1440, "height": 900})
            take(page, places[START], "start")
            take(page, places[COMPARISONS], "comparisons")
            take(page, f"{runs}/{kinds['training']}", "run")
            browser.close()
    finally:
        os.killpg(server.pid, signal.SIGKILL)


if __name__ == "__main__":
    main()
