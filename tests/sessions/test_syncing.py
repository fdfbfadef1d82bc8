"""Run folders that go to a real MLflow server and come back, into a real store of another outputs folder."""

import gzip
import io
import json
import re
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any, ClassVar, cast

import PIL.Image
import pytest
from hydra import compose, initialize_config_dir
from mlflow.store.entities import PagedList

from atlantis_exp.commands import CONF
from atlantis_exp.commands.composing import checked
from atlantis_exp.commands.sync import SyncConfig
from atlantis_exp.faults import Fault
from atlantis_exp.runs.files import write_file
from atlantis_exp.runs.folder import Result, RunFolder
from atlantis_exp.runs.journal import Commit, Journal, adopt, commit_bytes, read_commit
from atlantis_exp.sessions.syncing import Look, _tell, sync
from atlantis_exp.tracking import travel
from atlantis_exp.tracking.publishing import catch_up
from atlantis_exp.tracking.store import Files, Store, TooSlow, _pages, files_digest, publish, unfinished
from atlantis_exp.tracking.travel import _journal

REPOSITORY = Path(__file__).parents[2]
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


def synced(outputs: Path, *overrides: str) -> None:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = checked(SyncConfig, compose("sync", [f"paths.outputs={outputs}", *overrides]))
    sync(**vars(config), seconds=config.seconds)


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


def contents(outputs: Path) -> dict[str, bytes]:
    """The files of all run folders but checkpoints, locks and what MLflow was sent."""
    files = (path for path in outputs.glob("*/*/**/*") if path.is_file() and "checkpoints" not in path.parts)
    named = {str(path.relative_to(outputs)): path.read_bytes() for path in files}
    return {
        name: content
        for name, content in named.items()
        if not name.startswith("artifacts/")
        and not name.split("/")[2].startswith(("published", "origin", "lock", "holder"))
    }


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
        "tags": {key: value for key, value in tags.items() if key not in ("atlantis.folder", "atlantis.standing")},
        "models": sorted(
            (name, sorted(rows(root, model_tags, model)), rows(root, model_metrics, model)) for model, name in models
        ),
    }


@pytest.mark.slow
def test_runs_go_to_a_server_and_come_back_equal_and_once_and_then_what_is_new(
    tmp_path: Path, server: tuple[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    (address, behind), cluster, laptop = server, tmp_path / "cluster", tmp_path / "laptop"
    run = a_sweep_of_one(cluster, "whole")
    synced(cluster)
    for _ in range(2):
        synced(cluster, f"to={address}")
    for _ in range(2):
        synced(laptop, f"from={address}")
    here, there = f"to sqlite:///{laptop}/mlflow.db: 2 runs:", f"{address}: 2 runs:"
    both, printed = ["  published   sweeps/sweep-whole", "  published   runs/whole"], capsys.readouterr()
    assert printed.err == ""
    assert [line for line in printed.out.splitlines() if not WAITING.search(line)] == [
        *(*both, f"to sqlite:///{cluster}/mlflow.db: 2 runs: 2 published"),
        *(*both, f"to {there} 2 published", f"to {there} 2 up to date"),
        *("  brought     sweeps/sweep-whole", "  brought     runs/whole", f"from {there} 2 brought"),
        *(*both, f"{here} 2 published", f"from {there} 2 as here", f"{here} 2 up to date"),
    ]
    assert contents(laptop) == contents(cluster)
    for name in ("whole", "sweep whole"):
        assert shown(behind, name) == shown(laptop, name) == shown(cluster, name)
    assert len(shown(behind, "whole")["metrics"]) == 10

    journal = Journal(run)
    commit = read_commit(run)
    assert commit is not None
    journal.load_state_dict({"offset": commit.offset, "time": commit.updated})
    grow(journal, 5)
    synced(cluster)
    synced(cluster, f"to={address}")
    synced(laptop, f"from={address}")
    assert contents(laptop) == contents(cluster)
    assert shown(behind, "whole") == shown(laptop, "whole") == shown(cluster, "whole")
    assert len(shown(behind, "whole")["metrics"]) == 20
    sent = sorted(path.name for path in behind.glob("artifacts/*/*/artifacts/run_folder/journal/*") if commit.offset)
    assert sent.count(f"{commit.offset:012d}.gz") == 1


def test_the_looks_of_a_comparison_travel_with_it(tmp_path: Path, server: tuple[str, Path]) -> None:
    address, cluster, laptop = server[0], tmp_path / "cluster", tmp_path / "laptop"
    place = Path("comparisons/a-vs-b-0123456789")
    journal = Journal(cluster / place, {"mlflow.runName": "a-vs-b"})
    (cluster / place / "looks.json").write_text('{"model": []}')
    journal.metrics({"difference/a over b": 1.0}, 0)
    commit = journal.state_dict()
    journal.commit()
    journal.status("FINISHED")
    for looks in ('{"model": []}', '{"model": [{"error": 0.0125}]}'):
        (cluster / place / "looks.json").write_text(looks)
        synced(cluster, f"to={address}", "tracking.experiment=looks")
        synced(laptop, f"from={address}", "tracking.experiment=looks")
        assert (laptop / place / "looks.json").read_text() == looks
        journal.load_state_dict(commit)  # compared again
        journal.status("FINISHED")


@pytest.mark.slow
def test_a_run_goes_on_where_it_is_and_its_copy_is_nobodys_to_end_or_replace(
    tmp_path: Path, server: tuple[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    (address, behind), cluster, laptop = server, tmp_path / "cluster", tmp_path / "laptop"
    run = a_sweep_of_one(cluster, "moving")
    Journal(run).status("RUNNING")
    (run / "result.json").unlink()
    synced(cluster, f"to={address}", "tracking.experiment=moving")
    origin = f"from={address}"
    synced(laptop, origin, "tracking.experiment=moving")
    catch_up(laptop)
    copy = laptop / "runs/moving"
    assert (copy / "commit.json").read_bytes() == (run / "commit.json").read_bytes()

    with RunFolder(copy).held():  # it was continued there, say
        Journal(run).status("FINISHED")
        synced(cluster, f"to={address}", "tracking.experiment=moving")
        synced(laptop, origin, "tracking.experiment=moving")
    assert "held by process" in capsys.readouterr().err
    assert RunFolder(copy).status == "RUNNING"
    synced(laptop, origin, "tracking.experiment=moving")
    assert RunFolder(copy).status == "FINISHED"

    began_anew = Journal(copy)  # without a checkpoint: another history
    began_anew.metrics({"score/mean_100": 1.0}, 1)
    began_anew.state_dict()
    began_anew.commit()
    kept = contents(laptop)
    synced(laptop, origin, "tracking.experiment=moving")
    assert "is another run, which stays" in capsys.readouterr().err
    assert contents(laptop) == kept
    synced(laptop, f"to={address}", "tracking.experiment=moving")
    names = "SELECT status, lifecycle_stage FROM runs WHERE name = 'moving' ORDER BY status"
    assert rows(behind, names) == [("FINISHED", "active"), ("FINISHED", "active")]


@pytest.mark.slow
def test_a_copy_follows_a_run_that_went_back_behind_what_was_sent(tmp_path: Path, server: tuple[str, Path]) -> None:
    (address, behind), cluster, laptop = server, tmp_path / "cluster", tmp_path / "laptop"
    options = (f"from={address}", "tracking.experiment=back")
    run = a_sweep_of_one(cluster, "back")
    synced(cluster, f"to={address}", "tracking.experiment=back")
    synced(laptop, *options)
    journal = Journal(run)
    grow(journal, 7)
    synced(cluster, f"to={address}", "tracking.experiment=back")
    synced(laptop, *options)
    assert {name: content for name, content in contents(laptop).items() if "artifacts" not in name} == {
        name: content for name, content in contents(cluster).items() if "artifacts" not in name
    }
    assert shown(behind, "back") == shown(laptop, "back")


@pytest.mark.slow
def test_a_bringing_that_breaks_off_anywhere_is_made_good(
    tmp_path: Path, server: tuple[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    (address, behind), cluster, laptop = server, tmp_path / "cluster", tmp_path / "laptop"
    experiment = "tracking.experiment=broken"
    run, copy = a_sweep_of_one(cluster, "broken"), laptop / "runs/broken"
    synced(cluster, f"to={address}", experiment)

    def attempts(before: Commit | None) -> int:
        """How many it takes where each fails at one more file."""
        for fails_at in range(20):
            writes = iter(range(20))

            def write_or_fail(path: Path, content: bytes, fails_at: int = fails_at, writes: Any = writes) -> None:
                if next(writes) >= fails_at:
                    raise ValueError(f"no {path}")
                write_file(path, content)

            with monkeypatch.context() as patched:
                patched.setattr(travel, "write_file", write_or_fail)
                try:
                    synced(laptop, f"from={address}", experiment)
                    return fails_at + 1
                except Fault:
                    assert read_commit(copy) in (before, read_commit(run))
            if copy.exists():
                publish(copy, Store(laptop, "broken", address), is_primary=False)
                assert shown(behind, "broken") == sent
        raise AssertionError("it never came to an end")

    sent = shown(behind, "broken")
    assert attempts(None) == 7  # the sweep has a file and its commit, the run three, config, result and commit
    assert contents(laptop) == contents(cluster)

    journal, commit = Journal(run), read_commit(run)
    assert commit is not None
    journal.load_state_dict({"offset": commit.offset, "time": commit.updated})
    grow(journal, 5)
    synced(cluster, f"to={address}", experiment)
    sent = shown(behind, "broken")
    assert attempts(commit) == 7
    assert contents(laptop) == contents(cluster)


def test_what_a_server_says_leads_nowhere_outside(
    tmp_path: Path, server: tuple[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    laptop = tmp_path / "laptop"
    store = Store(tmp_path, "forged", server[0])
    line = b'{"kind":"artifact","path":"%s"}\n'

    def forge(folder: str, parent: str = "", path: bytes = b"a.txt", offset: int | None = None) -> None:
        """Make a run on the server as if a folder had been published."""
        journal = line % path
        commit = Commit("x", 1, 2, len(journal) if offset is None else offset, "FINISHED", parent=parent)
        files = {"commit.json": commit_bytes(commit)}
        run = store.client.create_run(store.experiment_id, tags={"atlantis.folder": folder}).info.run_id
        for name, content in {**files, "journal/000000000000.gz": gzip.compress(journal)}.items():
            (aside := tmp_path / Path(name).name).write_bytes(content)
            store.client.log_artifact(run, str(aside), str(Path("run_folder", name).parent))
        store.client.set_tag(run, "atlantis.standing", files_digest(files))

    forge("/home/x/runs/../..")
    forge("/home/x/runs/a b")
    forge("/home/x/artifacts/atlantis")
    forge("/home/x/runs/own", parent="../../runs/own")
    forge("/home/x/runs/far", parent="../../../etc/passwd")
    forge("/home/x/runs/path", path=b"../../../away")
    forge("/home/x/runs/absolute", path=b"/tmp/away")
    forge("/home/x/runs/endless", offset=2**30 + 1)
    forge("/home/x/runs/fine")
    with pytest.raises(Fault, match="8 of 9 runs failed"):
        synced(laptop, f"from={server[0]}", "tracking.experiment=forged")
    said = capsys.readouterr().err
    assert said.count("no run folder's place") == 4
    assert said.count("does not name a file inside") == 2
    assert said.count("its own parent") == 1
    assert said.count("its journal of 1,073,741,825 bytes is longer than 1,073,741,824") == 1
    assert "runs/fine/commit.json" in contents(laptop)
    assert not list(tmp_path.rglob("away"))
    assert {path.name for path in laptop.iterdir()} == {"runs", "mlflow.lock"}


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


@pytest.mark.parametrize("what", ["runs SET artifact_uri", "logged_models SET artifact_location"])
@pytest.mark.thinned(2)
def test_a_server_cannot_send_the_password_to_another_one(
    what: str,
    tmp_path: Path,
    server: tuple[str, Path],
    stranger: tuple[str, list[tuple[str, str | None]]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (host, asked), (uri, folder) = stranger, server
    monkeypatch.setenv("MLFLOW_TRACKING_USERNAME", "ann")
    monkeypatch.setenv("MLFLOW_TRACKING_PASSWORD", "secret")
    name = f"elsewhere-{what.split()[0]}"
    experiment = f"tracking.experiment={name}"
    a_sweep_of_one(tmp_path / "outputs", name)
    synced(tmp_path / "outputs", f"to={uri}", experiment)
    with closing(sqlite3.connect(folder / "mlflow.db")) as database, database:
        column = "run_uuid" if what.startswith("runs") else "source_run_id"
        ours = "SELECT run_uuid FROM runs WHERE name = ?"
        database.execute(f"UPDATE {what} = ? WHERE {column} IN ({ours})", (f"mlflow-artifacts://{host}/x", name))
    with pytest.raises(Fault, match="1 of 2 runs failed"):
        synced(tmp_path / "laptop", f"from={uri}", experiment)
    assert f"its files are said to be on {host}, another server, which is not asked" in capsys.readouterr().err
    assert asked == []


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
    monkeypatch.setattr("atlantis_exp.tracking.publishing._DRAIN_SECONDS", 0.5)
    catch_up(tmp_path, uri)
    assert asked
    (run / "published.json").write_text(json.dumps({"store": "http://h/$(x)#atlantis", "identity": "x"}))
    catch_up(tmp_path, uri)
    assert "sync 'to=http://h/$(x)' sends them" in capsys.readouterr().err


def test_pieces_of_a_journal_may_have_been_sent_again_from_its_beginning() -> None:
    whole = bytes(range(250)) * 4

    class Sent:
        """Old pieces of 500 bytes, and a later one of all."""

        pieces: ClassVar = {0: whole, 500: whole[500:900]}

        def names(self, _: str) -> set[str]:
            return {f"{begin:012d}.gz" for begin in self.pieces}

        def read(self, path: str, _: int) -> bytes:
            return gzip.compress(self.pieces[int(path[-15:-3])])

    for start in (0, 1, 500, 700, 900, 999):
        assert b"".join(_journal(cast(Files, Sent()), start, 1_000)) == whole[start:]
    with pytest.raises(ValueError, match="from byte 1000 on"):
        [*_journal(cast(Files, Sent()), 0, 1_001)]


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


@pytest.mark.slow
def test_it_goes_on_looking_until_it_is_interrupted(outputs: Path) -> None:
    command = (sys.executable, "-m", "atlantis_exp", "sync", "every=1s", f"paths.outputs={outputs}")
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell's background job lacks
    looking = subprocess.Popen(command, cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    signal.signal(signal.SIGINT, before)
    try:
        assert looking.stdout is not None
        while WAITING.search(line := looking.stdout.readline()):
            pass
        assert line.endswith("mlflow.db: 0 runs\n")
        a_sweep_of_one(outputs, "late")
        seen: set[str] = set()
        while not {"  published   runs/late\n", "  published   sweeps/sweep-late\n"} <= seen:
            seen.add(line := looking.stdout.readline())
            assert line
        looking.send_signal(signal.SIGINT)
        _, error = looking.communicate(timeout=60)
        assert (looking.returncode, error) == (130, "")
    finally:
        looking.kill()
        looking.wait()


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
def test_a_server_that_drips_is_given_up(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A byte now and then keeps every single wait short, and a page token keeps every list going."""
    dripped = bytearray()
    answers: dict[str, object] = {}

    class Drip(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            answer = next((json.dumps(answers[path]).encode() for path in answers if path in self.path), b"")
            self.send_response(200)
            self.send_header("Content-Length", str(len(answer) or 100_000))
            self.end_headers()
            with suppress(OSError):
                self.wfile.write(answer)
                while not answer:
                    self.wfile.write(b" ")
                    dripped.append(0)
                    time.sleep(0.2)

        do_POST = do_GET

        def log_message(self, *_: object) -> None: ...

    monkeypatch.setattr("atlantis_exp.tracking.store._SECONDS", 2)
    with ThreadingHTTPServer(("127.0.0.1", 0), Drip) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        uri = f"http://127.0.0.1:{server.server_address[1]}"
        began = time.monotonic()
        with pytest.raises(TooSlow):
            Store(tmp_path, "x", uri).files("mlflow-artifacts:/a").read("b", 1_000)
        with pytest.raises(Fault, match="cannot be reached"):
            synced(tmp_path, f"from={uri}")
        answers |= {"get-by-name": {"experiment": {"experiment_id": "1"}}, "runs/search": {}, "experiments/get?": {}}
        a_sweep_of_one(tmp_path, "plain")
        with pytest.raises(Fault, match="cannot be reached: TooSlow"):
            synced(tmp_path, f"to={uri}")
        server.shutdown()
    assert len(dripped) > 10
    assert time.monotonic() - began < 30


def test_what_a_server_calls_a_run_is_one_line_that_a_terminal_does_not_obey(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(Fault, match="1 of 1 runs failed"):
        _tell("from x", [Look("failed", "a\x1b]52;c;cm0=\x07\nfrom y: 9 runs", "no\x9b2J")], is_first=True)
    assert capsys.readouterr().err == "atlantis_exp: a]52;c;cm0= from y: 9 runs: failed: no2J\n"


def test_lists_and_files_without_end_are_refused(
    server: tuple[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    uri, _ = server
    a_sweep_of_one(tmp_path / "outputs", "large")
    synced(tmp_path / "outputs", f"to={uri}", "tracking.experiment=large")
    monkeypatch.setattr(travel, "SMALL", 10)
    with pytest.raises(Fault, match="2 of 2 runs failed"):
        synced(tmp_path / "laptop", f"from={uri}", "tracking.experiment=large")
    assert "has more than 10 bytes on the server" in capsys.readouterr().err
    assert not list((tmp_path / "laptop").glob("*/*/*"))  # nothing of what was refused

    monkeypatch.setattr("atlantis_exp.tracking.store._PAGES", 5)
    with pytest.raises(ValueError, match="lists more than 5 pages"):
        list(_pages(lambda page_token: PagedList([], f"{page_token}more")))


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
            synced(tmp_path, f"from=http://127.0.0.1:{server.server_address[1]}")
        server.shutdown()
    assert passwords[0] is not None
    assert {password for _, password in asked} == {None}
