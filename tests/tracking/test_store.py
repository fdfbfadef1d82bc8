import signal
import subprocess
import sys
from pathlib import Path

import pytest

from atlantis_exp.runs.journal import Journal
from atlantis_exp.tracking.mirror import publish
from atlantis_exp.tracking.store import Store
from tests.tracking.folders import commit, rows

REPOSITORY = Path(__file__).parents[2]


def test_importing_the_store_does_not_import_mlflow() -> None:
    check = "import atlantis_exp.tracking.store, sys; assert 'mlflow' not in sys.modules"
    subprocess.run([sys.executable, "-c", check], cwd=REPOSITORY, check=True)


def test_runs_are_found_by_name_with_their_folder(tmp_path: Path, store: Store) -> None:
    for name in ("resnet-0", "resnet-1"):
        journal = Journal(tmp_path / name)
        journal.params({"seed": name[-1]})
        commit(journal)
        publish(tmp_path / name, store)
    [found] = store.runs("resnet-1")
    shown = found.data.tags["atlantis.folder"], found.data.params, found.info.status
    assert shown == (str(tmp_path / "resnet-1"), {"seed": "1"}, "RUNNING")
    assert {"resnet-0", "resnet-1"} <= {run.info.run_name for run in store.runs()}
    assert store.runs("nobody") == []


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
