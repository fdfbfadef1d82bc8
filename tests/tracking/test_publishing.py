"""What keeps the store up to date while a command works, and what it does first with what earlier ones left."""

import json
import os
import sqlite3
import threading
import time
from collections.abc import Callable
from contextlib import closing
from itertools import takewhile
from pathlib import Path

import pytest

from atlantis_exp.config import Config
from atlantis_exp.faults import Fault
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.journal import Journal, adopt, read_commit
from atlantis_exp.tracking import publishing
from atlantis_exp.tracking.mirror import Cursor, publish
from atlantis_exp.tracking.publishing import Publisher, catch_up, how_to_open, lacking, unfinished
from atlantis_exp.tracking.store import Store
from tests.tracking.folders import (
    a_full_journal,
    commit,
    everything,
    journaled_points,
    points,
    rows,
    run_id,
)


def test_a_run_that_ends_while_it_is_looked_at_is_not_called_killed(
    tmp_path: Path, recorded: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, states = RunFolder(recorded()), []
    journal = Journal(folder.path)
    journal.status("RUNNING")
    with monkeypatch.context() as asked:
        asked.setattr(RunFolder, "is_held", property(lambda _: journal.status("FINISHED")))
        catch_up(tmp_path)
    states.append(folder.state)
    journal.status("RUNNING")
    catch_up(tmp_path)
    assert [*states, folder.state] == ["done", "interrupted"]


def test_a_folder_whose_commit_is_not_a_file_is_one_line(
    tmp_path: Path, recorded: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = recorded()
    (folder / "commit.json").unlink()
    os.mkfifo(folder / "commit.json")
    catch_up(tmp_path)
    said = capsys.readouterr().err
    assert said.startswith(f"atlantis_exp: {folder / 'commit.json'} is damaged")
    assert said.count("\n") == 1


@pytest.fixture
def behind(tmp_path: Path) -> Callable[[str, str | None], Path]:
    """Writes the folder of a run that a store, the local one or a server, lacks."""

    def write(name: str, server: str | None = None) -> Path:
        folder = tmp_path / "runs" / name
        journal = Journal(folder)
        journal.metrics({"score": 1.0}, 1)
        journal.finish()
        address, identity = Store(tmp_path, tracking_uri=server).address, read_commit(folder).identity  # type: ignore[union-attr]
        Cursor(address, identity).save(folder / "published.json")
        return folder

    return write


def test_what_earlier_commands_left_is_published_but_for_runs_that_do_so_themselves(
    tmp_path: Path, behind: Callable[[str], Path]
) -> None:
    continued, left, running = (behind(name) for name in ("continued", "left", "running"))
    Journal(running).status("RUNNING")
    with RunFolder(running).held():
        catch_up(tmp_path, continued=continued)
    lacking = [unfinished(folder, tmp_path) is not None for folder in (continued, left, running)]
    assert lacking == [True, False, True]


def test_a_server_that_is_named_is_asked_once_and_not_again_for_each_run(
    tmp_path: Path,
    behind: Callable[[str, str], Path],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    uri = "http://127.0.0.1:9"
    first, second = (behind(name, uri) for name in ("first", "second"))
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
    catch_up(tmp_path, seconds=1.0)
    assert "lacks parts" not in capsys.readouterr().err
    assert (first / "published.lock").exists()
    assert not (second / "published.lock").exists()


def test_a_command_publishes_its_run_and_others_and_says_where_it_could_not(
    tmp_path: Path, tiny: Callable[..., Config], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, other = (RunFolder(tmp_path / "runs" / name) for name in ("own", "other"))
    Journal(other.path).status("RUNNING")
    local, none = (tiny(f"tracking={name}").tracking for name in ("mlflow", "none"))
    away = tiny("tracking=server", "tracking.uri=http://127.0.0.1:9").tracking
    with publishing.publishing(folder, none, tmp_path, {}, [other]) as journal:
        journal.status("RUNNING")
    assert not list(tmp_path.rglob("published*"))
    assert not list(tmp_path.glob("mlflow*"))
    with publishing.publishing(folder, local, tmp_path, {"kind": "x"}, [other], seconds=120):
        pass
    assert {run.info.run_name for run in Store(tmp_path).runs()} == {"own", "other"}
    assert capsys.readouterr().err == ""
    with publishing.publishing(folder, away, tmp_path, {}, seconds=0.1):
        pass
    assert "MLflow has not received all of own yet" in capsys.readouterr().err


def test_the_way_to_the_ui_says_how_many_runs_the_store_lacks(tmp_path: Path) -> None:
    outputs = tmp_path / "a b"
    command = f"\nthe MLflow UI: python -m atlantis_exp ui 'paths.outputs=\"{outputs}\"'"
    assert how_to_open(outputs) == ""
    runs = [outputs / "runs" / name for name in ("first", "second")]
    for folder in runs:
        a_full_journal(folder)
    adopt(outputs / "runs" / "queued", runs[0])
    assert how_to_open(outputs) == f"{command} (publishes 2 runs that it lacks first)\n"
    publish(runs[0], Store(outputs))
    with pytest.raises(Exception, match="refused"):
        publish(runs[1], Store(outputs, tracking_uri="http://127.0.0.1:9"))
    assert [folder.path for folder in lacking(outputs)] == [runs[1]]
    publish(runs[1], Store(outputs), is_primary=False)
    assert how_to_open(outputs) == f"{command}\n"
    (outputs / "mlflow.db").unlink()
    assert how_to_open(outputs) == f"{command} (publishes 2 runs that it lacks first)\n"


def test_a_publisher_follows_the_run_until_it_is_drained(tmp_path: Path, root: Path, store: Store) -> None:
    journal = a_full_journal(tmp_path)
    publisher = Publisher(tmp_path, store)
    patience = time.monotonic() + 120
    while not (tmp_path / "published.json").exists() or unfinished(tmp_path, root) is not None:
        assert time.monotonic() < patience
        time.sleep(0.05)
    journal.metrics({"score": 1}, 200)
    commit(journal)
    assert publisher.drain(120)
    assert points(root, tmp_path) == journaled_points(tmp_path)


def test_a_publisher_takes_others_along_whatever_becomes_of_one_and_leaves_those_that_have_yet_to_start(
    tmp_path: Path, root: Path, store: Store
) -> None:
    folders = [tmp_path / name for name in ("sweep", "damaged", "waiting", "whole")]
    for folder in (folders[0], folders[1], folders[3]):
        a_full_journal(folder)
    whole = (folders[1] / "journal.jsonl").read_bytes()
    (folders[1] / "journal.jsonl").write_bytes(whole[:-10])
    adopt(folders[2], folders[0])
    publisher = Publisher(folders[0], store, others=folders[1:])
    patience = time.monotonic() + 240
    while unfinished(folders[3], root) is not None or not (folders[3] / "published.json").exists():
        assert time.monotonic() < patience
        time.sleep(0.05)
    assert publisher.drain(60)  # no waiting would mend the damaged one
    for folder in (folders[0], folders[3]):
        assert points(root, folder) == journaled_points(folder)
    assert not (folders[2] / "published.json").exists()
    (folders[1] / "journal.jsonl").write_bytes(whole)
    publish(folders[1], store)
    assert points(root, folders[1]) == journaled_points(folders[1])


def test_two_publishers_of_one_folder_make_one_run(tmp_path: Path, root: Path, store: Store) -> None:
    a_full_journal(tmp_path)
    publishers = [Publisher(tmp_path, store) for _ in range(2)]
    assert all(publisher.drain(120) for publisher in publishers)
    identity = json.loads((tmp_path / "commit.json").read_bytes())["identity"]
    assert len(rows(root, "SELECT * FROM tags WHERE value = ?", identity)) == 1
    assert points(root, tmp_path) == journaled_points(tmp_path)


def test_a_folder_remembers_the_store_that_lacks_a_part_of_it(tmp_path: Path, store: Store) -> None:
    away = Store(tmp_path, "sweep", "http://127.0.0.1:9")
    journal = a_full_journal(tmp_path)
    assert unfinished(tmp_path, tmp_path) is None
    with pytest.raises(Exception, match="refused"):
        publish(tmp_path, away)
    lacking = unfinished(tmp_path, tmp_path)
    assert lacking is not None
    assert lacking.address == away.address
    publish(tmp_path, store)
    assert unfinished(tmp_path, tmp_path) is None
    journal.status("FINISHED")
    lacking = unfinished(tmp_path, store._root)
    assert lacking is not None
    assert lacking.address == store.address


@pytest.mark.timeout(100)
def test_what_is_a_folders_own_fault_is_one_line_at_once_and_no_reason_to_leave_the_others(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folders = {name: tmp_path / "runs" / name for name in ("lock", "step", "tag", "whole")}
    for name, folder in folders.items():
        journal = Journal(folder)
        journal.tags({"a__b": "x"})
        journal.metrics({"score": 1.0}, 2**63 if name == "step" else 1)
        journal.finish()
        Cursor(Store(tmp_path).address, read_commit(folder).identity).save(folder / "published.json")  # type: ignore[union-attr]
    lines = folders["tag"] / "journal.jsonl"
    lines.write_bytes(lines.read_bytes().replace(b"a__b", b"a//b"))
    (folders["lock"] / "published.lock").symlink_to("elsewhere")
    catch_up(tmp_path, seconds=200)  # it would wait so long for a store
    assert unfinished(folders["whole"], tmp_path) is None
    said = [record.getMessage() for record in caplog.records if record.name == publishing.__name__]
    assert [line.split(" (")[0] for line in said] == [
        f"runs/{name} cannot be published" for name in ("lock", "step", "tag")
    ]


def test_everything_arrives_after_another_writer_held_the_database(tmp_path: Path, root: Path, store: Store) -> None:
    a_full_journal(tmp_path).status("FINISHED")
    assert store.client
    with closing(sqlite3.connect(root / "mlflow.db", isolation_level=None)) as writer:
        writer.execute("BEGIN IMMEDIATE")
        publisher = Publisher(tmp_path, store)
        assert not publisher.drain(1.0)
        assert run_id(tmp_path) == ""
        writer.execute("ROLLBACK")
    assert publisher.drain(120)
    assert everything(root, tmp_path)["metrics"] == journaled_points(tmp_path)


def test_a_publisher_that_nobody_waits_for_tries_less_and_less_often(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = threading.Semaphore(0)

    def fail(*_: object) -> None:
        tried.release()
        raise Fault("out of reach")

    monkeypatch.setattr(publishing, "publish", fail)
    publisher = Publisher(tmp_path, Store(tmp_path), interval=120)
    assert not publisher.drain(0.5)  # one try at once, one in a second
    tries = list(takewhile(bool, (tried.acquire(timeout=3) for _ in range(9))))
    assert 2 <= len(tries) <= 3
    monkeypatch.setattr(publishing, "publish", lambda *_: None)
    assert publisher.drain(30)  # wakes it


def test_a_store_out_of_reach_is_reported_once_and_caught_up_with_once_it_is_back(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, folder = tmp_path / "store", tmp_path / "run"
    monkeypatch.chdir(tmp_path)
    failed = threading.Event()

    class Counted(Store):
        attempts = 0

        def fault(self, error: Exception) -> Fault | None:
            self.attempts += 1
            if self.attempts == 3:
                failed.set()
            return super().fault(error)

    root.write_text("in the way")
    journal = a_full_journal(folder)
    publisher = Publisher(folder, Counted(root), interval=0.01)
    assert failed.wait(120)
    journal.metrics({"score": 1}, 200)
    commit(journal)
    assert not publisher.drain(0.1)
    root.unlink()
    assert publisher.drain(120)
    assert points(root, folder) == journaled_points(folder)
    said = [record.getMessage() for record in caplog.records if record.name == publishing.__name__]
    assert [line.split(" (")[0] for line in said] == [
        "Publishing to MLflow fails",
        "Publishing to MLflow works again and is up to date",
    ]
    assert rows(root, "PRAGMA journal_mode") == [("wal",)]
    assert [str(path.relative_to(root)) for path in root.glob("artifacts/*")] == ["artifacts/atlantis"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run", "store"]  # nothing in the working directory
