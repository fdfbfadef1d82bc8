"""Run folders published in a real store and on a real MLflow server."""

import io
import json
import re
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import PIL.Image
import pytest
from hydra import compose, initialize_config_dir
from mlflow.store.entities import PagedList

from atlantis_exp.commands import CONF
from atlantis_exp.commands.composing import checked
from atlantis_exp.commands.sync import SyncConfig
from atlantis_exp.faults import Fault
from atlantis_exp.runs.folder import Result, RunFolder
from atlantis_exp.runs.journal import Journal, adopt, read_commit
from atlantis_exp.sessions.syncing import publish_all, sync
from atlantis_exp.tracking.mirror import publish
from atlantis_exp.tracking.publishing import catch_up, unfinished
from atlantis_exp.tracking.store import Store, all_pages

WAITING = re.compile(r", \d+ s$")
"""Lines that say what is waited for, on a slow machine."""

Served = Callable[[Path, int], AbstractContextManager[None]]


@pytest.fixture(scope="module")
def server(
    tmp_path_factory: pytest.TempPathFactory, free_port: Callable[[], int], mlflow_server: Served
) -> Iterator[tuple[str, Path]]:
    """A server's address and the folder of its database and files."""
    folder, port = tmp_path_factory.mktemp("server"), free_port()
    with mlflow_server(folder, port):
        yield f"http://127.0.0.1:{port}", folder


def config_of(outputs: Path, *overrides: str) -> SyncConfig:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return checked(SyncConfig, compose("sync", [f"paths.outputs={outputs}", *overrides]))


def synced(outputs: Path, *overrides: str) -> None:
    config = config_of(outputs, *overrides)
    sync(**{**vars(config), "every": config.seconds})


def png(grey: int) -> bytes:
    content = io.BytesIO()
    PIL.Image.new("L", (8, 4), grey).save(content, "PNG", compress_level=0)  # other bytes than MLflow would write
    return content.getvalue()


def grow(journal: Journal, start: int) -> None:
    """Add five steps of everything that a journal can hold, and commit."""
    for step in range(start, start + 5):
        journal.metrics({"score/mean_100": step, "learning/loss": float("nan") if step == 2 else step / 7}, step)
    journal.tags({"mlflow.note.content": f"at step {start}"})
    journal.image("score/histogram", png(start), start)
    journal.model("network", bytes([start]), start + 4, {"score/mean_100": start + 4}, best=True)
    journal.artifact("evaluation/report.txt", f"report {start}".encode())
    journal.state_dict()
    journal.commit()


def a_sweep_of_one(outputs: Path, name: str) -> Path:
    """Write the folders of a finished run and its sweep, as commands do; returns the run's."""
    run, parent = RunFolder(outputs / "runs" / name), RunFolder(outputs / "sweeps" / f"sweep-{name}")
    page = Journal(parent.path, {"mlflow.runName": f"sweep {name}"})
    page.artifact("runs.csv", b"run\n")
    page.state_dict()
    page.commit()
    page.status("FINISHED")
    journal = Journal(run.path, {"mlflow.runName": name})
    run.write_config({"seed": 0})
    journal.params({"seed": "0"})
    grow(journal, 0)
    journal.status("FINISHED")
    run.write_result(Result("finished", 5, {}, {}, ""))
    (run.path / "checkpoints").mkdir()
    (run.path / "checkpoints" / "memory").write_bytes(b"large")
    adopt(run.path, parent.path)
    return run.path


def rows(folder: Path, query: str, *values: Any) -> list[tuple[Any, ...]]:
    with closing(sqlite3.connect(folder / "mlflow.db")) as database:
        return database.execute(query, values).fetchall()


def shown(root: Path, run: str) -> dict[str, Any]:
    """What a database says of the run of that name, its ids and places left out."""
    [(run_id, status, started)] = rows(
        root, "SELECT run_uuid, status, start_time FROM runs WHERE name = ? AND lifecycle_stage = 'active'", run
    )
    metrics = rows(root, "SELECT key, step, timestamp, value, is_nan FROM metrics WHERE run_uuid = ?", run_id)
    tags = dict(rows(root, "SELECT key, value FROM tags WHERE run_uuid = ?", run_id))
    parent = rows(root, "SELECT name FROM runs WHERE run_uuid = ?", tags.pop("mlflow.parentRunId", None))
    models = rows(root, "SELECT model_id, name FROM logged_models WHERE source_run_id = ?", run_id)
    model_tags = "SELECT tag_key, tag_value FROM logged_model_tags WHERE model_id = ? AND tag_key IN ('step', 'best')"
    model_metrics = "SELECT metric_name, metric_step, metric_value FROM logged_model_metrics WHERE model_id = ?"
    return {
        "run": (status, started, parent),
        "metrics": sorted(metrics),
        "params": sorted(rows(root, "SELECT key, value FROM params WHERE run_uuid = ?", run_id)),
        "tags": {key: value for key, value in tags.items() if key != "atlantis.folder"},
        "models": sorted(
            (name, sorted(rows(root, model_tags, model)), rows(root, model_metrics, model)) for model, name in models
        ),
    }


@pytest.mark.slow
def test_runs_go_to_a_server_equal_and_once_and_then_what_is_new(
    tmp_path: Path, server: tuple[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    (address, behind), outputs = server, tmp_path / "outputs"
    run = a_sweep_of_one(outputs, "whole")
    synced(outputs)
    for _ in range(2):
        synced(outputs, f"to={address}")
    there = f"to {address}: 2 runs:"
    both, printed = ["  published   sweeps/sweep-whole", "  published   runs/whole"], capsys.readouterr()
    assert printed.err == ""
    assert [line for line in printed.out.splitlines() if not WAITING.search(line)] == [
        *(*both, f"to sqlite:///{outputs}/mlflow.db: 2 runs: 2 published"),
        *(*both, f"{there} 2 published", f"{there} 2 up to date"),
    ]
    for name in ("whole", "sweep whole"):
        assert shown(behind, name) == shown(outputs, name)
    assert len(shown(behind, "whole")["metrics"]) == 10

    journal, commit = Journal(run), read_commit(run)
    assert commit is not None
    journal.load_state_dict({"offset": commit.offset, "time": commit.updated})
    grow(journal, 5)
    synced(outputs)
    synced(outputs, f"to={address}")
    assert shown(behind, "whole") == shown(outputs, "whole")
    assert len(shown(behind, "whole")["metrics"]) == 20


@pytest.fixture
def stranger() -> Iterator[tuple[str, list[tuple[str, str | None]]]]:
    """Another server's host and port, and what it was asked for: paths, each with the password that came with it."""
    asked: list[tuple[str, str | None]] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append((self.path, self.headers["Authorization"]))
            self.send_response(404)
            self.end_headers()

        do_POST = do_GET

        def log_message(self, *_: object) -> None: ...

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as other:
        Thread(target=other.serve_forever, daemon=True).start()
        yield f"127.0.0.1:{other.server_address[1]}", asked
        other.shutdown()


def test_a_folder_that_names_a_server_is_not_sent_there_with_the_password(
    tmp_path: Path,
    stranger: tuple[str, list[tuple[str, str | None]]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_USERNAME", "me")
    monkeypatch.setenv("MLFLOW_TRACKING_PASSWORD", "secret")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    host, asked = stranger
    uri = f"http://{host}"
    run = a_sweep_of_one(tmp_path, "copied")
    for folder in (run, tmp_path / "sweeps/sweep-copied"):
        (folder / "published.json").write_text(json.dumps({"store": f"{uri}#atlantis", "identity": "x"}))
    catch_up(tmp_path)
    assert asked == []
    said = f"atlantis_exp: {uri} lacks parts of 2 runs; python -m atlantis_exp sync to={uri} sends them\n"
    assert capsys.readouterr().err.endswith(said)
    catch_up(tmp_path, uri, seconds=0.5)
    patience = time.monotonic() + 120
    while not asked:
        assert time.monotonic() < patience
        time.sleep(0.05)
    (run / "published.json").write_text(json.dumps({"store": "http://h/$(x)#atlantis", "identity": "x"}))
    catch_up(tmp_path, uri, seconds=0.5)
    assert "sync 'to=\"http://h/$(x)\"' sends them" in capsys.readouterr().err


def test_every_folder_of_the_outputs_is_published_and_stays_at_home(tmp_path: Path) -> None:
    a_sweep_of_one(tmp_path, "plain")
    away = a_sweep_of_one(tmp_path, "away")
    with pytest.raises(Exception, match="refused"):
        publish(away, Store(tmp_path, tracking_uri="http://127.0.0.1:9"))
    synced(tmp_path)
    assert rows(tmp_path, "SELECT count(*) FROM runs") == [(4,)]
    lacking = unfinished(away, tmp_path)
    assert lacking is not None
    assert lacking.uri == "http://127.0.0.1:9"
    assert unfinished(tmp_path / "runs/plain", tmp_path) is None


def test_a_store_that_was_thrown_away_is_made_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a_sweep_of_one(tmp_path, "plain")
    synced(tmp_path)
    before = shown(tmp_path, "plain")
    (tmp_path / "mlflow.db").unlink()
    capsys.readouterr()
    synced(tmp_path)
    assert capsys.readouterr().out.endswith(": 2 runs: 2 published\n")
    assert shown(tmp_path, "plain") == before
    synced(tmp_path)
    assert capsys.readouterr().out.endswith(": 2 runs: 2 up to date\n")


def test_it_looks_again_and_says_only_what_changed_until_it_is_interrupted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a_sweep_of_one(tmp_path, "plain")
    told: list[str] = []

    def wait(seconds: float) -> None:
        assert seconds == 30
        told.append("".join(line for line in "".join(capsys.readouterr()).splitlines(True) if not WAITING.search(line)))
        if len(told) == 2:
            (tmp_path / "runs/plain/commit.json").write_text("{")
        if len(told) == 3:
            raise KeyboardInterrupt

    config = config_of(tmp_path, "every=30s")
    with pytest.raises(SystemExit, match="130"):
        sync(**{**vars(config), "every": config.seconds}, wait=wait)
    first, second, third = told
    assert first.endswith(": 2 runs: 2 published\n")
    assert second == ""
    assert "1 failed, 1 up to date" in third
    assert third.endswith("1 of 2 runs failed; trying again in 30 s\n")


def test_a_store_that_fails_in_the_middle_ends_it_and_a_folder_that_fails_does_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    class Failing(Store):
        is_gone = False

        def fault(self, error: Exception) -> Fault | None:
            return Fault(f"no answer: {error}") if self.is_gone else None

    a_sweep_of_one(tmp_path, "plain")
    (tmp_path / "sweeps/sweep-plain/commit.json").write_text("{")
    store = Failing(tmp_path)
    with pytest.raises(Fault, match="2 of 2 runs failed"):  # the run's parent, too
        publish_all(tmp_path, store)
    assert capsys.readouterr().err.count(": failed: ") == 2
    store.is_gone = True
    with pytest.raises(Fault, match="no answer"):
        publish_all(tmp_path, store)


@pytest.mark.slow
def test_a_server_out_of_reach_and_a_damaged_folder_are_one_line_each(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a_sweep_of_one(tmp_path, "plain")
    with pytest.raises(Fault, match=r"^http://127.0.0.1:9 cannot be reached: .*refused"):
        synced(tmp_path, "to=http://127.0.0.1:9")
    (tmp_path / "runs/plain/commit.json").write_text("{")
    with pytest.raises(Fault, match="1 of 2 runs failed"):
        synced(tmp_path)
    assert "commit.json is damaged" in capsys.readouterr().err


@pytest.mark.slow
def test_a_server_that_drips_is_given_up(tmp_path: Path) -> None:
    """A byte now and then keeps every single wait short."""
    dripped = bytearray()

    class Drip(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Length", "100000")
            self.end_headers()
            with suppress(OSError):
                while True:
                    self.wfile.write(b" ")
                    dripped.append(0)
                    time.sleep(0.2)

        do_POST = do_GET

        def log_message(self, *_: object) -> None: ...

    with ThreadingHTTPServer(("127.0.0.1", 0), Drip) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        began = time.monotonic()
        store = Store(tmp_path, tracking_uri=f"http://127.0.0.1:{server.server_address[1]}", patience=2)
        with pytest.raises(Fault, match=r"cannot be reached: TooSlow.*within 2 seconds"):
            publish_all(tmp_path, store)
        server.shutdown()
    assert len(dripped) > 5
    assert time.monotonic() - began < 30


def test_a_folder_is_named_in_one_line_that_a_terminal_does_not_obey(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = RunFolder(tmp_path / "a\x1b]52;c;cm0=\x07\nto y: 9 runs\x9b2J")
    folder.path.mkdir()
    (folder.path / "commit.json").write_text("{")
    with pytest.raises(Fault, match="1 of 1 runs failed"):
        publish_all(tmp_path, Store(tmp_path), [folder])
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("atlantis_exp: a]52;c;cm0= to y: 9 runs2J: failed: ")
    assert line.isprintable()


def test_a_list_without_end_is_refused() -> None:
    with pytest.raises(ValueError, match="lists more than 1,000 pages"):
        all_pages(lambda page_token: PagedList([], f"{page_token}more"))


def test_a_redirect_to_another_server_takes_no_password_along(
    stranger: tuple[str, list[tuple[str, str | None]]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    host, asked = stranger
    monkeypatch.setenv("MLFLOW_TRACKING_USERNAME", "ann")
    monkeypatch.setenv("MLFLOW_TRACKING_PASSWORD", "secret")
    passwords: list[str | None] = []

    class Redirects(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            passwords.append(self.headers["Authorization"])
            self.send_response(307)
            self.send_header("Location", f"http://{host}{self.path}")
            self.end_headers()

        do_POST = do_GET

        def log_message(self, *_: object) -> None: ...

    with ThreadingHTTPServer(("127.0.0.1", 0), Redirects) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        with pytest.raises(Fault, match="cannot be reached"):
            synced(tmp_path, f"to=http://127.0.0.1:{server.server_address[1]}")
        server.shutdown()
    assert passwords[0] is not None
    assert {password for _, password in asked} == {None}
