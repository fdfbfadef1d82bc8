"""The MLflow UI as a person sees it: in a real browser, on a small sweep.

The browser is the system's chromium or the one that playwright has installed; without either the tests are skipped.
"""

import asyncio
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest
from hydra import compose, initialize_config_dir

from atlantis_exp.commands import CONF
from atlantis_exp.commands.composing import checked
from atlantis_exp.config import Config, PathsConfig
from atlantis_exp.runs.journal import Journal
from atlantis_exp.sessions.job import Job
from atlantis_exp.sessions.serving import serve
from atlantis_exp.sessions.sweep import ledger
from atlantis_exp.sessions.training import train
from atlantis_exp.tracking import views
from atlantis_exp.tracking.mirror import publish
from atlantis_exp.tracking.store import Store

REPOSITORY = Path(__file__).parents[2]
COMMAND = (sys.executable, "-m", "atlantis_exp", "ui")
SECONDS = 60_000  # that a page may take, in ms


def a_finished_run(folder: Path) -> None:
    journal = Journal(folder)
    journal.metrics({"evaluation/mean": 1.0}, 1)
    journal.finish()


def test_the_ui_listens_on_this_machine_alone_and_has_no_assistant(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, free_port: Callable[[], int]
) -> None:
    served: dict[str, Any] = {}
    monkeypatch.setattr("uvicorn.run", lambda pages, **settings: served.update(pages=pages, **settings))
    serve(port=free_port(), paths=PathsConfig(outputs=str(tmp_path)))
    assert served["host"] == "127.0.0.1"
    sent: list[Any] = []

    async def send(message: Any) -> None:
        sent.append(message)

    async def receive() -> None: ...

    scope = {"type": "http", "method": "GET", "path": "/ajax-api/3.0/mlflow/assistant/config", "headers": []}
    asyncio.run(served["pages"](scope, receive, send))
    assert sent[0]["status"] == 404


@pytest.fixture(scope="module")
def page() -> Iterator[Any]:
    """A page in a browser; any type, since playwright need not be there."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    browser_file = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    with playwright.sync_playwright() as started:
        try:
            browser = started.chromium.launch(executable_path=browser_file, args=["--no-sandbox"])
        except playwright.Error as error:
            pytest.skip(f"there is no browser: {str(error).splitlines()[0]}")
        context = browser.new_context(viewport={"width": 1600, "height": 2400})
        context.set_default_timeout(SECONDS)
        yield context.new_page()
        browser.close()


@pytest.fixture(scope="module")
def outputs(page: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:  # noqa: ARG001  no browser, no sweep
    """A sweep of two seeds, with films."""
    folder = tmp_path_factory.mktemp("outputs")
    overrides = (
        *("experiment=quick", "device=cpu", "threads=1", "tracking.every_steps=20", "budget.forecast=off"),
        *("env.size=40", "env.max_steps=40", "phase.quick.steps=160", "replay.capacity=120"),
        *("training.learn_start=20", "training.learn_every=4", "training.batch_size=4", "training.precision=fp32"),
        *("evaluation.episodes=2", "evaluation.num_envs=1", "evaluation.every_steps=80", f"paths.outputs={folder}"),
    )
    with initialize_config_dir(str(CONF), version_base="1.3"):
        configs = [checked(Config, compose("config", [*overrides, f"seed={seed}"])) for seed in (0, 1)]
    jobs = [Job(config, ("quick",)) for config in configs]
    with ledger(jobs, ["seed=0,1"]):
        for job in jobs:
            train(job)
    return folder


@pytest.fixture(scope="module")
def address(outputs: Path, free_port: Callable[[], int], answering: Callable[..., None]) -> Iterator[str]:
    """The address that the command prints, once the server answers."""
    port = free_port()
    server = subprocess.Popen(
        (*COMMAND, f"port={port}", f"paths.outputs={outputs}"),
        cwd=REPOSITORY,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert server.stdout is not None
    shown = next(line for line in server.stdout if line.startswith("MLflow UI: ")).split()[-1]
    answering(server, port)
    yield shown
    server.send_signal(signal.SIGINT)
    assert server.wait() == 0


@pytest.mark.slow
def test_the_runs_that_the_store_lacks_are_published_and_the_plain_address_leads_to_them(
    tmp_path: Path, free_port: Callable[[], int], answering: Callable[..., None]
) -> None:
    a_finished_run(tmp_path / "runs" / "first")
    publish(tmp_path / "runs" / "first", Store(tmp_path))
    a_finished_run(tmp_path / "runs" / "copied from elsewhere")
    port = free_port()
    server = subprocess.Popen(
        (*COMMAND, f"port={port}", f"paths.outputs={tmp_path}"), cwd=REPOSITORY, stdout=subprocess.PIPE, text=True
    )
    try:
        answering(server, port)
        with urlopen(f"http://127.0.0.1:{port}/") as page:
            assert 'location.replace("/#/experiments/1/runs?' in page.read().decode()
        with pytest.raises(HTTPError, match="403"):  # MLflow's guard against other sites
            urlopen(Request(f"http://127.0.0.1:{port}/", headers={"Host": "elsewhere.org"}))
    finally:
        server.send_signal(signal.SIGINT)
    shown, _ = server.communicate(timeout=60)
    assert server.returncode == 0
    assert "  published   runs/copied from elsewhere\n" in shown
    assert "runs/first" not in shown
    assert f"MLflow UI: http://127.0.0.1:{port}\n" in shown
    assert {run.info.run_name for run in Store(tmp_path).runs()} == {"first", "copied from elsewhere"}


@pytest.mark.slow
def test_the_server_listens_on_this_machine_alone(address: str) -> None:
    port = int(address.rpartition(":")[2])
    tables = [Path("/proc/net", name).read_text().splitlines()[1:] for name in ("tcp", "tcp6")]
    listening = [line.split()[1] for table in tables for line in table if line.split()[3] == "0A"]
    assert [place for place in listening if place.endswith(f":{port:04X}")] == [f"0100007F:{port:04X}"]


@pytest.mark.slow
@pytest.mark.parametrize("path", ["config", "message", "sessions/1/stream"])
def test_mlflows_assistant_which_can_run_a_shell_is_left_out(address: str, path: str) -> None:
    with pytest.raises(HTTPError, match="404"):
        urlopen(f"{address}/ajax-api/3.0/mlflow/assistant/{path}", timeout=30)


@pytest.mark.slow
def test_mlflows_assistant_does_not_cover_the_first_page(page: Any, address: str) -> None:
    page.goto(address)
    page.get_by_text("cnn uniform s0 quick").first.wait_for()
    assert page.get_by_placeholder("Ask a question").count() == 0


def runs_page(address: str, place: str) -> str:
    return f"{address}/#/experiments/1/runs{place}"


SCRIPT = "<script>attacked=1</script><img src=x onerror=attacked=1>`<svg/onload=attacked=1> [a](javascript:attacked=1)"


@pytest.mark.slow
def test_no_text_of_a_run_runs_a_script_in_mlflows_pages(page: Any, address: str, outputs: Path) -> None:
    folder = outputs / "runs" / SCRIPT.replace("/", "-")
    journal = Journal(folder, {"mlflow.runName": SCRIPT, "group": SCRIPT, "atlantis.kind": "training"})
    journal.params({"model.name": SCRIPT})
    journal.tags({"command": SCRIPT})
    journal.note(f"{SCRIPT}\n\n| {SCRIPT} |\n| --- |\n| {SCRIPT} |")
    journal.flush()
    journal.status("FAILED", SCRIPT)
    publish(folder, Store(outputs))
    (run,) = [run.info.run_id for run in Store(outputs).runs() if run.info.run_name == SCRIPT]
    for place in (address, runs_page(address, f"/{run}")):
        page.goto("about:blank")
        page.goto(place)
        page.get_by_text("attacked=1").first.wait_for(state="attached")
        page.wait_for_timeout(1_000)  # ms, in which a picture is not found
        assert page.evaluate("typeof attacked") == "undefined", place
        assert page.locator("a[href^=javascript]").count() == 0, place


@pytest.fixture
def run_id(outputs: Path) -> Callable[[str], str]:
    """The id of the run whose name starts so."""
    runs = Store(outputs).runs()
    return lambda start: min(run.info.run_id for run in runs if run.info.run_name.startswith(start))


def size_of(image: Any) -> list[int]:
    image.evaluate("image => image.decode()")
    size: list[int] = image.evaluate("image => [image.naturalWidth, image.naturalHeight]")
    return size


@pytest.mark.slow
def test_the_address_opens_on_charts_of_every_run_and_pictures_with_a_slider(page: Any, address: str) -> None:
    page.goto(address)
    page.get_by_text("cnn uniform s0 quick").first.wait_for()
    curves = page.locator(".js-plotly-plot .scatterlayer .trace")
    curves.first.wait_for()
    page.wait_for_function("document.querySelectorAll('.js-plotly-plot .scatterlayer .trace').length >= 4")
    sections = re.findall(r"(\w+)\s*\(\d+\)", page.inner_text("body"))
    assert sections[:2] == ["score", "evaluation"]
    page.get_by_text("pictures", exact=True).last.scroll_into_view_if_needed()  # MLflow draws what is in sight
    picture = page.locator("img[src*='score~histogram']").first
    picture.wait_for()
    assert size_of(picture) == [256, 256]
    slider = page.get_by_role("slider").first
    before = picture.get_attribute("src")
    slider.focus()
    slider.press("ArrowRight")
    page.wait_for_function(
        "before => document.querySelector(\"img[src*='score~histogram']\")?.getAttribute('src') != before", arg=before
    )


@pytest.mark.slow
def test_the_first_chart_shows_the_score_of_every_run(page: Any, address: str, outputs: Path) -> None:
    page.goto("about:blank")  # else only the part behind '#' changes, and the application begins with the old view
    page.goto(address)
    chart = page.locator(".js-plotly-plot:has(.barlayer)").first
    chart.locator(".bartext").first.wait_for()
    store = Store(outputs)
    metrics = [run.data.metrics for run in store.runs()]
    scores = [each["evaluation/interquartile_mean"] for each in metrics if "evaluation/interquartile_mean" in each]
    assert sorted(chart.locator(".bartext").all_text_contents()) == sorted(f"{score:.2f}" for score in scores)


@pytest.mark.slow
def test_the_sweep_view_has_a_curve_a_group(page: Any, address: str) -> None:
    page.goto("about:blank")  # else only the part behind '#' changes, and the application begins with the old view
    page.goto(views.address(address, "1", views.SWEEP))
    page.get_by_text("Group: cnn uniform quick").first.wait_for()
    page.locator(".js-plotly-plot .scatterlayer .trace").first.wait_for()
    assert page.get_by_text("cnn uniform quick").count() > 1  # the legends' as well


@pytest.mark.slow
def test_the_film_plays_inside_its_run(page: Any, address: str, run_id: Callable[[str], str]) -> None:
    page.goto(runs_page(address, f"/{run_id('cnn')}/artifacts/best_episode.mp4"))
    film = page.locator("video")
    film.wait_for()
    page.wait_for_function("document.querySelector('video').readyState >= 2")
    assert film.evaluate("film => [film.videoWidth, film.videoHeight]") == [560, 420]
    film.evaluate("film => { film.muted = true; return film.play() }")
    page.wait_for_function("document.querySelector('video').currentTime > 0")


@pytest.mark.slow
def test_the_pages_of_a_run_and_of_a_sweep_begin_with_their_results(
    page: Any, address: str, run_id: Callable[[str], str]
) -> None:
    page.goto(runs_page(address, f"/{run_id('cnn')}"))
    page.get_by_text("The best mean so far is").wait_for()
    page.goto(runs_page(address, f"/{run_id('sweep')}"))
    page.get_by_text("IQM", exact=True).first.wait_for()


def test_a_port_in_use_is_one_line(tmp_path: Path) -> None:
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        held.listen()
        port = held.getsockname()[1]
        command = (*COMMAND, f"port={port}", f"paths.outputs={tmp_path}")
        ended = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout) == (1, "")
    assert ended.stderr == f"atlantis_exp: port={port}: Address already in use; choose another, as in port=5001\n"
    assert not list(tmp_path.iterdir())
