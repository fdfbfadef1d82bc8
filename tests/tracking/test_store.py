import re
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing, nullcontext
from pathlib import Path
from typing import cast

import pytest
from mlflow import MlflowClient
from mlflow.exceptions import MlflowException

from atlantis_exp.faults import Fault
from atlantis_exp.runs.journal import Journal
from atlantis_exp.sessions.syncing import publish_all
from atlantis_exp.tracking.mirror import publish
from atlantis_exp.tracking.publishing import Publisher
from atlantis_exp.tracking.server import PatientClient, TooSlow
from atlantis_exp.tracking.store import Store, first_line
from tests.tracking.folders import a_full_journal, commit, rows

REPOSITORY = Path(__file__).parents[2]


def test_importing_the_store_does_not_import_mlflow() -> None:
    check = "import atlantis_exp.tracking.store, sys; assert 'mlflow' not in sys.modules"
    subprocess.run([sys.executable, "-c", check], cwd=REPOSITORY, check=True)


def test_runs_are_found_with_their_folder(tmp_path: Path, store: Store) -> None:
    for name in ("resnet-0", "resnet-1"):
        journal = Journal(tmp_path / name)
        journal.params({"seed": name[-1]})
        commit(journal)
        publish(tmp_path / name, store)
    [found] = [run for run in store.runs() if run.info.run_name == "resnet-1"]
    shown = found.data.tags["atlantis.folder"], found.data.params, found.info.status
    assert shown == (str(tmp_path / "resnet-1"), {"seed": "1"}, "RUNNING")
    assert {"resnet-0", "resnet-1"} <= {run.info.run_name for run in store.runs()}


@pytest.mark.slow
@pytest.mark.usefixtures("stores_without_tables")
def test_a_process_killed_while_it_makes_the_tables_breaks_nothing(tmp_path: Path) -> None:
    killed = f"""
import os, signal, sqlalchemy
from pathlib import Path
from atlantis_exp.tracking.store import Store
@sqlalchemy.event.listens_for(sqlalchemy.engine.Engine, "after_cursor_execute")
def die(connection, cursor, statement, *_):
    if "CREATE TABLE scorers" in statement:
        os.kill(os.getpid(), signal.SIGKILL)
Store(Path({str(tmp_path)!r})).client
"""
    process = subprocess.run([sys.executable, "-c", killed], cwd=REPOSITORY, check=False)
    assert process.returncode == -signal.SIGKILL
    assert Store(tmp_path).runs() == []
    assert sorted(path.name for path in tmp_path.glob("mlflow*") if "-" not in path.name) == [
        "mlflow.db",
        "mlflow.lock",
    ]


@pytest.mark.slow
def test_eight_processes_start_on_a_fresh_store_at_once(tmp_path: Path) -> None:
    script = f"""
import sys
import time
from pathlib import Path
from atlantis_exp.runs.journal import Journal
from atlantis_exp.tracking.mirror import publish
from atlantis_exp.tracking.store import Store
folder = Path({str(tmp_path)!r}, sys.argv[1])
journal = Journal(folder)
journal.metrics({{"score": 1.0}}, 1)
journal.state_dict()
journal.commit()
publish(folder, Store(Path({str(tmp_path)!r}, "store")))
"""
    processes = [
        subprocess.Popen([sys.executable, "-c", script, f"run-{i}"], cwd=REPOSITORY, stderr=subprocess.PIPE)
        for i in range(8)
    ]
    assert [process.communicate()[1] for process in processes] == [b""] * 8  # and it is quiet about it
    assert [process.returncode for process in processes] == [0] * 8
    assert rows(tmp_path / "store", "SELECT count(*) FROM metrics") == [(8,)]
    assert rows(tmp_path / "store", "SELECT count(*) FROM experiments WHERE name = 'atlantis'") == [(1,)]


def test_an_experiment_that_was_deleted_is_restored_and_a_line_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "runs" / "run"
    journal = a_full_journal(folder)
    publish(folder, store := Store(tmp_path))
    store.client.delete_experiment(store.experiment_id)
    journal.status("FINISHED")
    publish(folder, Store(tmp_path))
    assert rows(tmp_path, "SELECT status, lifecycle_stage FROM runs") == [("FINISHED", "active")]
    assert [record.getMessage() for record in caplog.records] == [
        "Restored the deleted MLflow experiment atlantis with its runs"
    ]


def damage(database: Path) -> None:
    database.write_bytes(b"no database" * 1_000)


def age(database: Path) -> None:
    with closing(sqlite3.connect(database)) as opened, opened:
        opened.execute("UPDATE alembic_version SET version_num = '6953534de441'")


def renew(database: Path) -> None:
    with closing(sqlite3.connect(database)) as opened, opened:
        opened.execute("UPDATE alembic_version SET version_num = 'ffffffffffff'")


@pytest.mark.parametrize("spoil", [damage, age, renew])
def test_a_database_that_cannot_be_used_is_one_line_with_the_remedy_for_every_command(
    tmp_path: Path,
    mlflow_tables: Callable[[Path], None],
    caplog: pytest.LogCaptureFixture,
    spoil: Callable[[Path], None],
) -> None:
    mlflow_tables(tmp_path)
    spoil(tmp_path / "mlflow.db")
    folder = tmp_path / "runs" / "run"
    a_full_journal(folder)
    remedy = rf"move it away, and .* sync paths.outputs={tmp_path} rebuilds it"
    said = rf"{tmp_path}/mlflow.db cannot be used \(.*\): {remedy}"
    with pytest.raises(Fault, match=said):
        publish_all(tmp_path, Store(tmp_path))
    with pytest.raises(Fault, match=said):
        Store(tmp_path).prepare()
    publisher = Publisher(folder, Store(tmp_path))
    line = rf"Publishing to MLflow fails \({said}\); the run continues and is published later"
    patience = time.monotonic() + 120
    while not any(re.fullmatch(line, record.getMessage()) for record in caplog.records):
        assert time.monotonic() < patience
        time.sleep(0.05)
    (tmp_path / "mlflow.db").unlink()
    mlflow_tables(tmp_path)
    assert publisher.drain(120)


def test_the_databases_reason_is_named_and_not_the_advice_above_it() -> None:
    error = MlflowException(
        "(raised as a result of autoflush;\n see below)\n(sqlite3.OperationalError) database is locked\n"
    )
    assert first_line(error) == "(sqlite3.OperationalError) database is locked"
    assert first_line(ValueError("one\ntwo")) == "ValueError: one"


@pytest.mark.parametrize("pieces", [0, 1])
def test_a_server_has_a_second_and_one_more_for_each_piece_of_a_file(tmp_path: Path, pieces: int) -> None:
    class Server:
        def log_artifact(self, _: str, path: str) -> None:
            assert Path(path).stat().st_size == pieces * 2**16
            try:
                time.sleep(1.5)
            except TooSlow as error:
                raise MlflowException("wrapped") from error

    file = tmp_path / "file"
    file.write_bytes(bytes(pieces * 2**16))
    client = PatientClient(cast(MlflowClient, Server()), 1)
    with nullcontext() if pieces else pytest.raises(TooSlow, match="within 1 seconds"):
        client.log_artifact("run", str(file))


def test_a_database_that_breaks_while_it_is_used_is_the_stores_fault(tmp_path: Path) -> None:
    store = Store(tmp_path)
    assert store.client
    error = MlflowException("(sqlite3.DatabaseError) database disk image is malformed")
    assert "move it away" in str(store.fault(error))
    assert "move it away" in str(store.fault(sqlite3.DatabaseError("database disk image is malformed")))
    assert store.fault(ValueError("a folder's own")) is None
    assert store.fault(OverflowError("too large")) is None
