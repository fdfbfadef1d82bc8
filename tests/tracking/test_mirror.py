import io
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

import PIL.Image
import pytest

from atlantis_exp.config import Config
from atlantis_exp.runs.folder import TRACEBACK
from atlantis_exp.runs.journal import Commit, Journal, adopt, commit_bytes, read, read_commit
from atlantis_exp.tracking.local import Point
from atlantis_exp.tracking.mirror import publish
from atlantis_exp.tracking.publishing import unfinished
from atlantis_exp.tracking.store import Store
from atlantis_exp.training.checkpoint import Checkpoints
from atlantis_exp.training.trainer import Trainer
from tests.tracking.folders import (
    a_full_journal,
    commit,
    everything,
    journaled_points,
    png,
    points,
    rows,
    run_id,
    same_but_for_ids,
)


def test_mlflow_shows_what_is_committed_and_no_more(tmp_path: Path, root: Path, store: Store) -> None:
    journal = Journal(tmp_path)
    journal.metrics({"score": 1}, 1)
    commit(journal)
    journal.metrics({"score": 2}, 2)
    journal.state_dict()
    publish(tmp_path, store)
    assert [point[1] for point in points(root, tmp_path)] == [1]
    journal.commit()
    publish(tmp_path, store)
    assert [point[1] for point in points(root, tmp_path)] == [1, 2]


def test_metrics_whose_checkpoint_could_not_be_written_are_not_shown(
    tmp_path: Path,
    root: Path,
    store: Store,
    tiny: Callable[..., Config],
    started: Callable[[Config, Path], Trainer],
) -> None:
    class FullDisk(Checkpoints):
        def save(self, *_: object) -> NoReturn:
            raise OSError("no space")

    trainer = started(tiny(), tmp_path)
    trainer.recorder.journal.status("RUNNING")
    trainer.recorder.journal.metrics({"score": 1.0}, 1)
    trainer.checkpoints = FullDisk(tmp_path / "checkpoints", "x")
    with pytest.raises(OSError, match="no space"):
        trainer.run(stop=lambda: True)
    publish(tmp_path, store)
    assert points(root, tmp_path) == []
    trainer.checkpoints = Checkpoints(tmp_path / "checkpoints", "x")
    trainer.commit()
    publish(tmp_path, store)
    assert [point[:2] for point in points(root, tmp_path)] == [("score", 1)]


def test_a_folder_is_mirrored_whole(tmp_path: Path, root: Path, store: Store) -> None:
    folder = tmp_path / "a run"
    a_full_journal(folder).status("FINISHED")
    publish(folder, store)
    shown = everything(root, folder)
    assert (shown["status"], shown["name"]) == ("FINISHED", "a run")
    assert shown["metrics"] == journaled_points(folder)
    assert len(shown["params"]) == 150
    assert ("mlflow.note.content", "# note") in shown["tags"]
    assert ("mlflow.loggedImages", "True") in shown["tags"]
    assert {path: shown["files"][path] for path in ("report/index.html", "top.txt")} == {
        "report/index.html": b"<p>",
        "top.txt": b"top",
    }
    assert len(shown["files"]) == 2 + 2 * 2  # an image is a full and a small file
    assert sorted(model[1:] for model in shown["models"]) == [
        (f"{shown['name']} {step}", 2, [bytes(step)])
        for step in (100, 50)  # as text
    ]
    assert [step for _, step in shown["outputs"]] == [50, 100]
    assert {model for model, _ in shown["outputs"]} == {model[0] for model in shown["models"]}
    assert len(shown["model metrics"]) == 2


def test_publishing_everything_again_changes_nothing(tmp_path: Path, root: Path, store: Store) -> None:
    a_full_journal(tmp_path).status("FINISHED")
    publish(tmp_path, store)
    shown, cursor = everything(root, tmp_path), (tmp_path / "published.json").read_bytes()
    (tmp_path / "published.json").unlink()
    publish(tmp_path, store)
    assert everything(root, tmp_path) == shown
    assert (tmp_path / "published.json").read_bytes() == cursor
    identity = json.loads(cursor)["identity"]
    assert len(rows(root, "SELECT * FROM tags WHERE value = ?", identity)) == 1


class FailsOnce(Store):
    """A store whose every call does its work and then fails, the first time that it is made."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self.done: set[str] = set()

    def _failing_once(self, name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(*arguments: Any, **options: Any) -> Any:
            result = call(*arguments, **options)
            key = re.sub(r"0x\w+", "", f"{name} {arguments} {options}")
            if key not in self.done:
                self.done.add(key)
                raise ConnectionError(key)
            return result

        return wrapper

    @property
    def client(self) -> Any:
        failing, client = self._failing_once, super().client

        class Client:
            def __getattr__(self, name: str) -> Callable[..., Any]:
                return failing(name, getattr(client, name))

        return Client()

    def put(self, *arguments: Any) -> None:
        self._failing_once("put", super().put)(*arguments)

    def log_points(self, *arguments: Any) -> None:
        self._failing_once("log_points", super().log_points)(*arguments)


def test_a_publication_that_fails_after_each_of_its_calls_doubles_nothing(tmp_path: Path, root: Path) -> None:
    a_full_journal(tmp_path).status("FINISHED")
    publish(tmp_path, Store(root, "unbroken"))
    unbroken = everything(root, tmp_path)
    store = FailsOnce(root)
    for _ in range(100):
        try:
            publish(tmp_path, store)
            break
        except ConnectionError:
            continue
    written = {"create_run", "log_points", "log_batch", "put", "set_terminated", "create_logged_model"}
    assert written | {"finalize_logged_model", "log_outputs"} <= {key.split()[0] for key in store.done}
    assert same_but_for_ids(everything(root, tmp_path)) == same_but_for_ids(unbroken)


def test_points_of_one_millisecond_survive_a_break_between_their_batches(
    tmp_path: Path, root: Path, store: Store
) -> None:
    lines = (
        json.dumps({"kind": "metrics", "step": step, "time": 1_700_000_000_000, "values": {"a": 1, "b": step}})
        for step in range(6_000)
    )
    journal = "".join(f"{line}\n" for line in lines).encode()
    (tmp_path / "journal.jsonl").write_bytes(journal)
    (tmp_path / "commit.json").write_bytes(commit_bytes(Commit("x", 1, 2, len(journal), "FINISHED")))

    class BreaksOff(Store):
        batches = 0

        def log_points(self, run_id: str, points: Sequence[Point]) -> None:
            self.batches += 1
            if self.batches == 2:
                raise OSError("no space")
            super().log_points(run_id, points)

    with pytest.raises(OSError, match="no space"):
        publish(tmp_path, BreaksOff(root))
    assert 0 < len(points(root, tmp_path)) < 12_000
    publish(tmp_path, store)
    assert points(root, tmp_path) == journaled_points(tmp_path)


def test_a_run_that_goes_back_behind_what_was_published_replaces_it(tmp_path: Path, root: Path, store: Store) -> None:
    class Broken(Store):
        def open_run(self, *_: Any) -> NoReturn:
            raise ConnectionError

    journal = a_full_journal(tmp_path)
    older = journal.state_dict()
    journal.metrics({"score": 99}, 200)
    journal.model("best", b"later", 200, {})
    commit(journal)
    publish(tmp_path, store)
    replaced = run_id(tmp_path)
    again = Journal(tmp_path)
    again.load_state_dict(older)
    again.metrics({"score": 1}, 200)
    commit(again)
    with pytest.raises(ConnectionError):
        publish(tmp_path, Broken(root))
    publish(tmp_path, store)
    assert run_id(tmp_path) != replaced
    assert points(root, tmp_path) == journaled_points(tmp_path)
    assert rows(root, "SELECT lifecycle_stage FROM runs WHERE run_uuid = ?", replaced) == [("deleted",)]
    listed = (
        "SELECT source_run_id, count(*) FROM logged_models WHERE lifecycle_stage = 'active' AND source_run_id IN (?, ?)"
    )
    assert rows(root, listed + " GROUP BY source_run_id", replaced, run_id(tmp_path)) == [(run_id(tmp_path), 2)]


def test_a_note_that_was_made_up_costs_no_other_run_its_place_in_the_store(
    tmp_path: Path, root: Path, store: Store
) -> None:
    theirs, ours = tmp_path / "theirs", tmp_path / "ours"
    a_full_journal(theirs)
    publish(theirs, store)
    before = everything(root, theirs)
    journal = Journal(ours)
    journal.metrics({"score": 1}, 1)
    commit(journal)
    identity = read_commit(ours).identity  # type: ignore[union-attr]
    note = json.loads((theirs / "published.json").read_text())
    for made_up in ({"identity": "another"}, {}, {"identity": identity}):  # to be deleted, twice, and to be written to
        (ours / "published.json").write_text(json.dumps({**note, **made_up, "offset": 0, "files": ""}))
        publish(ours, store)
        assert everything(root, theirs) == before
        assert points(root, ours) == journaled_points(ours)
        assert run_id(ours) != run_id(theirs)


def test_a_name_is_cut_to_what_a_database_takes(tmp_path: Path, root: Path, store: Store) -> None:
    journal = Journal(tmp_path, {"mlflow.runName": "s" * 300})
    for score in (1, 2):
        journal.metrics({"score": score}, score)
        commit(journal)
        publish(tmp_path, store)
        told = everything(root, tmp_path)
        assert told["name"] == "s" * 250
        assert ("mlflow.runName", "s" * 250) in told["tags"]


def test_a_folder_published_to_another_store_starts_anew_there_and_stays_here(
    tmp_path: Path, root: Path, store: Store
) -> None:
    a_full_journal(tmp_path)
    publish(tmp_path, store)
    here = run_id(tmp_path)
    publish(tmp_path, Store(root, "another"))
    assert points(root, tmp_path) == journaled_points(tmp_path)
    assert rows(root, "SELECT lifecycle_stage FROM runs WHERE run_uuid = ?", here) == [("active",)]
    assert run_id(tmp_path) != here


def test_a_traceback_beside_a_failure_is_shown_with_it(tmp_path: Path, root: Path, store: Store) -> None:
    journal = a_full_journal(tmp_path)
    (tmp_path / TRACEBACK).write_text("Traceback\nError")
    publish(tmp_path, store)
    assert not list((root / "artifacts").rglob(f"{run_id(tmp_path)}/artifacts/{TRACEBACK}"))
    journal.status("FAILED", "Error")
    publish(tmp_path, store)
    (shown,) = (root / "artifacts").rglob(f"{run_id(tmp_path)}/artifacts/{TRACEBACK}")
    assert shown.read_text() == "Traceback\nError"


def test_images_are_named_and_sized_as_mlflow_itself_does(tmp_path: Path, store: Store) -> None:
    journal = Journal(tmp_path)
    journal.image("evaluation/q values", png(7), 3)
    commit(journal)
    publish(tmp_path, store)
    run = store.client.create_run(store.experiment_id)
    with PIL.Image.open(io.BytesIO(png(7))) as image:
        [(_, record)] = read(tmp_path)
        store.client.log_image(run.info.run_id, image, key=record.key, step=3, timestamp=record.time)  # type: ignore[union-attr]

    def images(run_id: str) -> dict[str, Any]:
        folder = Path(store.client.get_run(run_id).info.artifact_uri.removeprefix("file://")) / "images"
        return {re.sub(r"[0-9a-f-]{36}", "ID", file.name): PIL.Image.open(file).size for file in folder.iterdir()}

    assert images(run_id(tmp_path)) == images(run.info.run_id)
    assert len(images(run.info.run_id)) == 2


@pytest.mark.parametrize(
    ("kind", "width", "end", "fault"),
    [
        ("EPS", 8, None, "is not a PNG of a run: not a PNG file"),  # PIL would have Ghostscript draw it
        ("PNG", 4_097, None, "4,097 x 4 pixels"),
        ("PNG", 8, 45, "is not a PNG"),
        ("PNG", 8, 0, "is not a PNG"),
    ],
)
def test_an_image_that_is_no_picture_of_ours_is_a_damaged_folders(
    tmp_path: Path, store: Store, kind: str, width: int, end: int | None, fault: str
) -> None:
    content = io.BytesIO()
    PIL.Image.new("L", (width, 4)).save(content, kind)
    journal = Journal(tmp_path)
    journal.image("score/heatmap", content.getvalue()[:end], 0)
    commit(journal)
    with pytest.raises(ValueError, match=fault):
        publish(tmp_path, store)


def test_infinite_values_stay_in_the_journal_and_nan_is_shown(tmp_path: Path, root: Path, store: Store) -> None:
    journal = Journal(tmp_path)
    journal.metrics({"up": float("inf"), "down": float("-inf"), "nan": float("nan"), "one": 1.0}, 1)
    commit(journal)
    publish(tmp_path, store)
    shown = rows(root, "SELECT key, is_nan FROM metrics WHERE run_uuid = ? ORDER BY key", run_id(tmp_path))
    assert shown == [("nan", 1), ("one", 0)]


def test_a_param_that_changes_becomes_a_tag(tmp_path: Path, root: Path, store: Store) -> None:
    journal = Journal(tmp_path)
    journal.params({"episodes": "10", "long": "x" * 7_000})
    journal.params({"episodes": "20", "long": "x" * 7_000})
    commit(journal)
    publish(tmp_path, store)
    shown = everything(root, tmp_path)
    assert shown["params"] == [("episodes", "10"), ("long", "x" * 6_000)]
    assert ("episodes", "20") in shown["tags"]
    assert "long" not in dict(shown["tags"])


def test_the_status_follows_the_run_through_its_sessions(tmp_path: Path, root: Path, store: Store) -> None:
    journal = Journal(tmp_path)
    journal.metrics({"score": 1}, 1)
    commit(journal)
    for status in ("RUNNING", "KILLED", "RUNNING", "FAILED", "RUNNING", "FINISHED"):
        journal.status(status)
        publish(tmp_path, store)
        [(shown, end)] = rows(root, "SELECT status, end_time FROM runs WHERE run_uuid = ?", run_id(tmp_path))
        updated = json.loads((tmp_path / "commit.json").read_bytes())["updated"]
        assert shown == status
        assert dict(everything(root, tmp_path)["tags"])["resumable"] == str(status in ("KILLED", "FAILED")).lower()
        assert status == "RUNNING" or end == updated
    assert points(root, tmp_path) == journaled_points(tmp_path)


def test_a_run_has_its_labels_and_the_error_it_failed_with_as_long_as_it_stands(tmp_path: Path, store: Store) -> None:
    Journal(tmp_path, {"mlflow.runName": "cnn s0", "mlflow.runColor": "#0072b2"}).status("FAILED", "no such device")
    publish(tmp_path, store)
    failed = store.client.get_run(run_id(tmp_path))
    assert (failed.info.run_name, failed.info.status) == ("cnn s0", "FAILED")
    assert failed.data.tags["error"] == "no such device"
    assert failed.data.tags["mlflow.runColor"] == "#0072b2"
    Journal(tmp_path, {"mlflow.runName": "cnn s0 again"}).status("FINISHED")
    publish(tmp_path, store)
    finished = store.client.get_run(run_id(tmp_path))
    assert (finished.info.run_id, finished.info.run_name) == (failed.info.run_id, "cnn s0 again")
    assert "error" not in finished.data.tags


def test_a_child_finds_its_parent_whichever_is_published_first_and_moves_to_another(
    tmp_path: Path, root: Path, store: Store
) -> None:
    child, first, second = (tmp_path / name for name in ("runs/child", "sweeps/first", "sweeps/second"))
    for parent in (first, second):
        Journal(parent).status("RUNNING")
    adopt(child, first)
    Journal(child).status("FINISHED")
    publish(child, store)
    publish(first, store)
    parent_of = "SELECT value FROM tags WHERE key = 'mlflow.parentRunId' AND run_uuid = ?"
    assert rows(root, parent_of, run_id(child)) == [(run_id(first),)]
    ended = rows(root, "SELECT end_time FROM runs WHERE run_uuid = ?", run_id(child))
    adopt(child, second)
    assert unfinished(child, root) is not None
    publish(child, store)
    assert rows(root, parent_of, run_id(child)) == [(run_id(second),)]
    assert rows(root, "SELECT end_time FROM runs WHERE run_uuid = ?", run_id(child)) == ended
    assert len(rows(root, "SELECT 1 FROM runs WHERE name = 'first'")) == 1


def test_the_best_model_alone_is_marked_however_often_it_is_sent(tmp_path: Path, store: Store) -> None:
    journal = Journal(tmp_path)
    for step, best in ((1, True), (2, True), (3, False)):
        journal.metrics({"score": float(step)}, step)
        journal.model("network", b"weights", step, {"score": float(step)}, best=best)
        commit(journal)
        publish(tmp_path, store)
    for _ in range(2):
        same = f"source_run_id = '{run_id(tmp_path)}'"
        models = store.client.search_logged_models([store.experiment_id], same)
        assert {model.tags["step"]: model.tags.get("best") for model in models} == {"1": None, "2": "true", "3": None}
        (tmp_path / "published.json").unlink()
        publish(tmp_path, store)


def test_a_file_that_is_gone_does_not_hold_up_the_rest(
    tmp_path: Path, root: Path, store: Store, caplog: pytest.LogCaptureFixture
) -> None:
    journal = Journal(tmp_path)
    journal.artifact("video.mp4", b"")
    journal.metrics({"score": 1}, 1)
    commit(journal)
    (tmp_path / "artifacts/video.mp4").unlink()
    publish(tmp_path, store)
    assert len(points(root, tmp_path)) == 1
    assert "1 files are missing and not published, such as video.mp4" in caplog.text


def test_a_folder_that_never_committed_is_left_alone(tmp_path: Path, store: Store) -> None:
    publish(tmp_path, store)
    assert not (tmp_path / "published.json").exists()


def test_a_run_that_somebody_deleted_in_mlflow_is_made_again_once_it_goes_on(
    tmp_path: Path, root: Path, store: Store
) -> None:
    journal = a_full_journal(tmp_path)
    publish(tmp_path, store)
    whole, gone = points(root, tmp_path), run_id(tmp_path)
    store.client.delete_run(gone)
    publish(tmp_path, store)
    assert run_id(tmp_path) == gone  # there is nothing new to send
    journal.status("FINISHED")
    publish(tmp_path, store)
    assert run_id(tmp_path) != gone
    assert points(root, tmp_path) == whole
    (tmp_path / "published.json").write_text(
        (tmp_path / "published.json").read_text().replace(run_id(tmp_path), "a" * 32)
    )
    journal.status("KILLED")
    publish(tmp_path, store)
    assert points(root, tmp_path) == whole


def test_a_folder_that_is_a_link_is_not_published(tmp_path: Path, store: Store) -> None:
    a_full_journal(tmp_path / "elsewhere")
    (tmp_path / "run").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ValueError, match="run is a link"):
        publish(tmp_path / "run", store)
    assert not (tmp_path / "elsewhere" / "published.json").exists()


def test_a_parent_that_is_a_link_is_not_published_and_none(tmp_path: Path, store: Store) -> None:
    run, sweep = tmp_path / "runs/run", tmp_path / "sweeps/sweep"
    a_full_journal(tmp_path / "elsewhere")
    sweep.parent.mkdir()
    sweep.symlink_to(tmp_path / "elsewhere")
    adopt(run, sweep)
    Journal(run).status("FINISHED")
    publish(run, store)
    assert not (tmp_path / "elsewhere" / "published.json").exists()
    assert "mlflow.parentRunId" not in store.client.get_run(run_id(run)).data.tags


@pytest.mark.parametrize("place", ["runs/a", "sweeps/a", "searches/a", "linked/a"])
@pytest.mark.timeout(60)
def test_a_folder_under_itself_has_no_parent(tmp_path: Path, store: Store, place: str) -> None:
    folder = tmp_path / place.replace("linked", "runs")
    Journal(folder).status("FINISHED")
    if place.startswith("linked"):
        (tmp_path / "sweeps").symlink_to("runs")
    commit = folder / "commit.json"
    commit.write_bytes(
        commit.read_bytes().replace(b'"parent":""', f'"parent":"../../{place.replace("linked", "sweeps")}"'.encode())
    )
    publish(folder, store)
    assert "mlflow.parentRunId" not in store.client.get_run(run_id(folder)).data.tags


def test_what_begins_anew_is_published_where_the_store_has_lost_its_run(tmp_path: Path, store: Store) -> None:
    note = tmp_path / "published.json"
    for _ in range(2):  # as a comparison does each time
        journal = Journal(tmp_path)
        journal.metrics({"score": 1.0}, 1)
        journal.finish()
        assert publish(tmp_path, store)
        note.write_text(note.read_text().replace(run_id(tmp_path), "a" * 32))


@pytest.mark.parametrize("damaged", ["", "{", '{"store": "a", "identity": "b", "offset": "many"}'])
def test_a_damaged_note_of_what_was_sent_doubles_nothing(
    tmp_path: Path, root: Path, store: Store, damaged: str
) -> None:
    a_full_journal(tmp_path)
    publish(tmp_path, store)
    shown = everything(root, tmp_path)
    (tmp_path / "published.json").write_text(damaged)
    publish(tmp_path, store)
    assert everything(root, tmp_path) == shown


def test_a_file_that_is_newer_than_the_commit_waits_for_its_own(tmp_path: Path, root: Path, store: Store) -> None:
    def film() -> bytes:
        (place,) = (root / "artifacts").rglob(f"{run_id(tmp_path)}/artifacts/film.mp4")
        return place.read_bytes()

    journal = Journal(tmp_path)
    journal.artifact("film.mp4", b"first")
    journal.flush()
    publish(tmp_path, store)
    journal.artifact("film.mp4", b"second")
    journal.flush()
    journal.artifact("film.mp4", b"third")  # a kill here leaves it on disk, and no record of it
    publish(tmp_path, store)
    assert film() == b"first"
    journal.flush()
    publish(tmp_path, store)
    assert film() == b"third"


def test_a_folder_that_begins_anew_while_it_is_read_is_read_again(tmp_path: Path, root: Path) -> None:
    """As a comparison does that is made again while another process publishes it."""

    class Meanwhile(Store):
        anew = False

        def open_run(self, folder: Path, commit: Commit) -> Any:
            if not self.anew:
                self.anew = True
                journal = Journal(folder)
                journal.metrics({"score": 1.0}, 1)
                journal.finish()
            return super().open_run(folder, commit)

    a_full_journal(tmp_path)
    assert publish(tmp_path, Meanwhile(root))
    assert points(root, tmp_path) == journaled_points(tmp_path)
    assert everything(root, tmp_path)["status"] == "FINISHED"
    identity = read_commit(tmp_path).identity  # type: ignore[union-attr]
    assert rows(root, "SELECT run_uuid FROM tags WHERE value = ?", identity) == [(run_id(tmp_path),)]
