"""A local store that is moved with its outputs folder, and its tables as MLflow's own client writes them."""

import math
import os
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from mlflow.entities import Metric

from atlantis_exp.runs.journal import Journal
from atlantis_exp.tracking.local import Point, make_database
from atlantis_exp.tracking.mirror import publish
from atlantis_exp.tracking.store import Store
from tests.tracking.folders import a_full_journal, everything, rows, run_id


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def moved(outputs: Path) -> Path:
    return outputs.rename(outputs.with_name("moved 100% there"))


def copied(outputs: Path) -> Path:
    return Path(shutil.copytree(outputs, outputs.with_name("copy")))


def with_a_parent_renamed(outputs: Path) -> Path:
    return outputs.parent.rename(outputs.parent.with_name("parent%20")) / outputs.name


def copied_from_where_nothing_may_be_written(outputs: Path) -> Path:
    copy = copied(outputs)
    for path in (outputs, *outputs.rglob("*")):
        path.chmod(0o500 if path.is_dir() else 0o400)
    return copy


def moved_and_linked_from_its_old_place(outputs: Path) -> Path:
    moved(outputs)
    outputs.symlink_to("moved 100% there")
    return outputs


@pytest.mark.parametrize(
    "put",
    [
        moved,
        copied,
        with_a_parent_renamed,
        copied_from_where_nothing_may_be_written,
        moved_and_linked_from_its_old_place,
    ],
)
def test_a_store_follows_its_outputs_folder_and_touches_the_old_place_no_more(
    tmp_path: Path, put: Callable[[Path], Path], caplog: pytest.LogCaptureFixture
) -> None:
    outputs = tmp_path / "parent" / "out %41 puts"
    a_full_journal(outputs / "runs" / "first").status("FINISHED")
    publish(outputs / "runs" / "first", Store(outputs))
    there = put(outputs)
    before = contents(outputs) if outputs.exists() and not outputs.is_symlink() else None
    first = there / "runs" / "first"
    Journal(first).status("KILLED")  # the run goes on
    a_full_journal(there / "runs" / "second").status("FINISHED")
    for folder in (first, there / "runs" / "second"):
        publish(folder, Store(there))
        shown = everything(there, folder)
        assert len(shown["files"]) == 6
        assert len(shown["models"]) == 2
        assert [file.path for file in Store(there).client.list_artifacts(run_id(folder), "report")] == [
            "report/index.html"
        ]
    assert [record.getMessage() for record in caplog.records if record.name.startswith("atlantis_exp")] == [
        f"{there.resolve()} was moved or copied from {outputs}: corrected the paths in its store"
    ]
    assert rows(there, "SELECT count(*) FROM runs WHERE lifecycle_stage = 'active'") == [(2,)]
    folders = rows(there, "SELECT value FROM tags WHERE key = 'atlantis.folder' ORDER BY value")
    assert folders == [(str(there.resolve() / "runs" / name),) for name in ("first", "second")]
    if before is None:
        assert outputs.is_symlink() or not outputs.exists()
    else:
        assert contents(outputs) == before


def test_a_folder_that_is_reached_through_a_link_stays_where_it_is(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "outputs").symlink_to("disk")
    for root in (tmp_path / "outputs", tmp_path / "disk", tmp_path / "outputs"):
        assert Store(root).client
    assert caplog.records == []


def test_an_experiment_whose_files_are_elsewhere_by_choice_keeps_them(
    tmp_path: Path, mlflow_tables: Callable[[Path], None]
) -> None:
    mlflow_tables(tmp_path)
    client = Store(tmp_path).client
    client.create_experiment("other", "file:///elsewhere")
    other = Store(tmp_path).client.get_experiment_by_name("other")
    assert other is not None
    assert other.artifact_location == "file:///elsewhere"


def test_points_are_stored_as_mlflows_own_client_stores_them(store: Store, root: Path) -> None:
    points: list[Point] = [
        ("a", 1.0, 1_000, 1),
        ("a", 3.0, 1_000, 1),
        ("a", 2.0, 1_000, 1),
        ("a", 7.0, 900, 2),
        ("a", 6.0, 2_000, 1),
        ("nan", math.nan, 1_000, 1),
        ("nan", 5.0, 1_000, 0),
        ("negative", -1.5, 1_000, -3),
        ("a", 1.0, 1_000, 1),
    ]

    def stored(write: Callable[[str], None]) -> list[list[tuple[Any, ...]]]:
        run = store.client.create_run(store.experiment_id).info.run_id
        write(run)
        write(run)
        tables = ("metrics", "latest_metrics")
        query = "SELECT key, value, timestamp, step, is_nan FROM {} WHERE run_uuid = ? ORDER BY 1, 2, 3, 4"
        return [rows(root, query.format(table), run) for table in tables]

    def theirs(run: str) -> None:
        store.client.log_batch(run, [Metric(*point) for point in points])

    assert stored(lambda run: store.log_points(run, points)) == stored(theirs)


@pytest.mark.slow
def test_what_is_left_of_a_database_that_was_removed_is_not_played_into_the_new_one(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "mlflow.db")) as database:
        database.execute("PRAGMA journal_mode=WAL")
        database.execute("CREATE TABLE old (x)")
        database.commit()
        shutil.copy(tmp_path / "mlflow.db-wal", tmp_path / "kept")  # as a process that was killed leaves it
    os.replace(tmp_path / "kept", tmp_path / "mlflow.db-wal")
    (tmp_path / "mlflow.db").unlink()
    make_database(tmp_path)
    assert rows(tmp_path, "SELECT name FROM sqlite_master WHERE name = 'old'") == []
    assert rows(tmp_path, "SELECT name FROM experiments") == [("Default",)]


def test_a_file_of_the_store_that_is_linked_from_a_copy_is_replaced_and_not_written_through(tmp_path: Path) -> None:
    folder = tmp_path / "runs" / "run"
    journal = Journal(folder)
    journal.artifact("a.txt", b"first")
    journal.finish()
    publish(folder, Store(tmp_path))
    file = tmp_path / "artifacts" / "atlantis" / run_id(folder) / "artifacts" / "a.txt"
    (tmp_path / "copy").hardlink_to(file)
    journal.artifact("a.txt", b"second")
    journal.finish()
    publish(folder, Store(tmp_path))
    assert (file.read_bytes(), (tmp_path / "copy").read_bytes()) == (b"second", b"first")
