import hashlib
import json
import os
import resource
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from atlantis_exp.runs.files import write_file
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.journal import (
    NOTE,
    Artifact,
    Image,
    Journal,
    JournalError,
    Metrics,
    Model,
    Params,
    Record,
    Tags,
    adopt,
    curve,
    has_lost_commit,
    read,
    read_commit,
)
from atlantis_exp.runs.lock import held


def records(folder: Path) -> list[Record]:
    return [record for _, record in read(folder)]


def steps(folder: Path) -> list[int]:
    return [record.step for record in records(folder) if isinstance(record, Metrics)]


def journaled(folder: Path, *steps: int) -> dict[str, Any]:
    journal = Journal(folder)
    for step in steps:
        journal.metrics({"score": step}, step)
    state = journal.state_dict()
    journal.commit()
    return state


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    def show(milliseconds: int) -> None:
        monkeypatch.setattr(time, "time_ns", lambda: milliseconds * 1_000_000)

    show(1_000)
    return show


def test_what_is_committed_is_read_back_in_its_order(tmp_path: Path, clock: Callable[[int], None]) -> None:
    journal = Journal(tmp_path)
    journal.params({"seed": "1"})
    journal.tags({"mlflow.note.content": "two\nlines"})
    clock(1_500)
    journal.metrics({"train/score": 200.0}, 7)
    journal.image("q/values", b"png", 7)
    journal.model("best", b"weights", 7, {"train/score": 200.0})
    journal.artifact("report/index.html", b"<p>")
    journal.state_dict()
    journal.commit()
    assert records(tmp_path) == [
        Params({"seed": "1"}),
        Tags({"mlflow.note.content": "two\nlines"}),
        Metrics(7, 1_500, {"train/score": 200.0}),
        Image("q/values", 7, 1_500, "images/q/values/7.png"),
        Model(
            *("best", 7, 1_500, "models/best/7.safetensors", {"train/score": 200.0}),
            sha256=hashlib.sha256(b"weights").hexdigest(),
        ),
        Artifact("report/index.html", hashlib.sha256(b"<p>").hexdigest()),
    ]
    assert [
        (tmp_path / "artifacts" / path).read_bytes() for path in ("images/q/values/7.png", "report/index.html")
    ] == [
        b"png",
        b"<p>",
    ]


def test_a_note_that_is_the_last_one_again_is_not_written_again(tmp_path: Path) -> None:
    journal = Journal(tmp_path)
    for text in ("one", "one", "two", "one"):
        journal.note(text)
    state = journal.state_dict()
    journal.note("three")
    journal.load_state_dict(state)
    journal.note("three")
    journal.flush()
    assert [value for record in records(tmp_path) for value in vars(record)["values"].values()] == [
        *("one", "two", "one", "three")
    ]


@settings(max_examples=30)
@given(st.dictionaries(st.from_regex(r"[a-z]{1,9}", fullmatch=True), st.floats(), min_size=1))
def test_every_float_survives_the_journal(values: dict[str, float]) -> None:
    with TemporaryDirectory() as folder:
        journal = Journal(Path(folder))
        journal.metrics(values, 0)
        journal.state_dict()
        journal.commit()
        [record] = records(Path(folder))
    assert isinstance(record, Metrics)
    assert {key: value.hex() for key, value in record.values.items()} == {key: v.hex() for key, v in values.items()}


def test_records_are_visible_only_after_a_commit_and_only_those_of_the_state(tmp_path: Path) -> None:
    journal = Journal(tmp_path)
    journal.metrics({"score": 1}, 1)
    state = journal.state_dict()
    assert records(tmp_path) == []
    journal.metrics({"score": 2}, 2)
    journal.commit()
    assert steps(tmp_path) == [1]
    commit = read_commit(tmp_path)
    assert commit is not None
    assert commit.offset == state["offset"]


def test_a_writer_without_checkpoints_goes_on_behind_what_it_has_flushed(
    tmp_path: Path, clock: Callable[[int], None]
) -> None:
    first = Journal(tmp_path)
    assert first.resume() is False
    first.note("what it is")
    first.metrics({"score": 1}, 1)
    first.flush()
    first.metrics({"score": 2}, 2)  # is lost
    clock(500)  # the clock has been set back
    second = Journal(tmp_path)
    assert second.resume()
    second.metrics({"score": 3}, 3)
    assert steps(tmp_path) == [1]
    second.finish()
    assert steps(tmp_path) == [1, 3]
    assert records(tmp_path)[0] == Tags({NOTE: "what it is"})
    times = [record.time for record in records(tmp_path) if isinstance(record, Metrics)]
    assert times == sorted(times)
    before, after = read_commit(tmp_path), Journal(tmp_path)._commit
    assert before is not None
    assert before.status == "FINISHED"
    assert before.identity == after.identity


def test_a_status_reveals_no_record(tmp_path: Path) -> None:
    journal = Journal(tmp_path)
    journal.metrics({"score": 1}, 1)
    journal.state_dict()
    journal.status("FAILED")
    commit = read_commit(tmp_path)
    assert commit is not None
    assert (commit.status, commit.offset, records(tmp_path)) == ("FAILED", 0, [])


@given(st.lists(st.sampled_from(["step", "state", "save", "commit", "crash"]), max_size=40))
def test_a_run_that_crashes_anywhere_shows_each_step_of_its_checkpoint_once(events: list[str]) -> None:
    with TemporaryDirectory() as name:
        folder = Path(name)
        journal, step, saved = Journal(folder), 0, None
        state: tuple[int, dict[str, Any]] | None = None  # as trainer and journal hand it to the checkpoint
        for event in [*events, "crash", "step", "state", "save", "commit"]:
            if event == "step":
                journal.metrics({"score": step}, step)
                step += 1
            elif event == "state":
                state = step, journal.state_dict()
            elif event == "save":
                saved = state
            elif event == "commit" and state is saved:  # nothing else is committed than what a checkpoint holds
                journal.commit()
            elif event == "crash":
                journal, step, state = Journal(folder), 0, saved
                if saved is not None:
                    step = saved[0]
                    journal.load_state_dict(saved[1])
        assert steps(folder) == list(range(step))


@pytest.mark.usefixtures("clock")
def test_a_resumed_journal_equals_an_unbroken_one_byte_for_byte(tmp_path: Path) -> None:
    journaled(tmp_path / "unbroken", *range(10))
    state = journaled(tmp_path / "resumed", *range(6))
    lost = Journal(tmp_path / "resumed")
    lost.load_state_dict(state)
    lost.metrics({"score": 99}, 6)
    lost.state_dict()
    journal = Journal(tmp_path / "resumed")
    journal.metrics({"score": 99}, 0)  # what precedes a load is forgotten too
    journal.load_state_dict(json.loads(json.dumps(state)))
    for step in range(6, 10):
        journal.metrics({"score": step}, step)
    journal.state_dict()
    journal.commit()
    assert (tmp_path / "resumed/journal.jsonl").read_bytes() == (tmp_path / "unbroken/journal.jsonl").read_bytes()


def test_a_crash_between_checkpoint_and_commit_loses_nothing(tmp_path: Path) -> None:
    journal = Journal(tmp_path)
    journal.metrics({"score": 1}, 1)
    journal.status("RUNNING")
    state = journal.state_dict()
    before = read_commit(tmp_path)
    resumed = Journal(tmp_path)
    resumed.load_state_dict(state)
    resumed.commit()
    after = read_commit(tmp_path)
    assert before is not None
    assert after is not None
    assert (steps(tmp_path), after.identity) == ([1], before.identity)


@pytest.mark.parametrize("resume", [True, False])
def test_a_journal_that_goes_back_behind_its_commit_is_a_new_run_to_its_readers(tmp_path: Path, resume: bool) -> None:
    journal = Journal(tmp_path)
    journal.metrics({"score": 1}, 1)
    older = journal.state_dict()
    journal.metrics({"score": 2}, 2)
    journal.state_dict()
    journal.commit()
    first = read_commit(tmp_path)
    again = Journal(tmp_path)
    if resume:
        again.load_state_dict(older)
    again.metrics({"score": 3}, 3)
    again.state_dict()
    between = read_commit(tmp_path)
    assert steps(tmp_path) == ([1] if resume else [])  # no reader meets the new bytes under the old commit
    again.commit()
    last = read_commit(tmp_path)
    assert steps(tmp_path) == ([1, 3] if resume else [3])
    assert first is not None
    assert between is not None
    assert last is not None
    assert first.identity != between.identity == last.identity


def test_time_never_runs_backwards_with_the_clock_nor_across_sessions(
    tmp_path: Path, clock: Callable[[int], None]
) -> None:
    journal = Journal(tmp_path)
    for now in (5_000, 4_000, 6_000):
        clock(now)
        journal.metrics({"score": 0}, now)
    state = journal.state_dict()
    clock(2_000)
    resumed = Journal(tmp_path)
    resumed.load_state_dict(state)
    resumed.metrics({"score": 0}, 2_000)
    resumed.state_dict()
    resumed.commit()
    assert [record.time for record in records(tmp_path) if isinstance(record, Metrics)] == [5_000, 5_000, 6_000, 6_000]


def test_a_journal_cut_below_its_commit_is_refused(tmp_path: Path) -> None:
    state = journaled(tmp_path, 1, 2)
    os.truncate(tmp_path / "journal.jsonl", state["offset"] - 5)
    with pytest.raises(ValueError, match="before its commit"):
        records(tmp_path)
    with pytest.raises(ValueError, match="shorter than in the checkpoint"):
        Journal(tmp_path).load_state_dict(state)


def test_a_journal_cut_under_its_writer_is_refused_and_not_filled_with_zeros(tmp_path: Path) -> None:
    """As where somebody removes the folder of a run that goes on, which makes it anew."""
    journal = Journal(tmp_path)
    journal.metrics({"score": 1}, 1)
    journal.state_dict()
    (tmp_path / "journal.jsonl").unlink()
    journal.metrics({"score": 2}, 2)
    with pytest.raises(ValueError, match="is shorter than its writer left it"):
        journal.state_dict()
    assert b"\0" not in (tmp_path / "journal.jsonl").read_bytes()


def test_a_journal_with_a_damaged_line_is_refused_before_anything_is_trained_on_it(tmp_path: Path) -> None:
    state = journaled(tmp_path, 1, 2)
    path = tmp_path / "journal.jsonl"
    path.write_bytes(bytes(20) + path.read_bytes()[20:])
    with pytest.raises(ValueError, match=r"byte 0: not a journal record.*resume=never"):
        Journal(tmp_path).load_state_dict(state)


def test_reading_starts_and_ends_where_it_is_told(tmp_path: Path) -> None:
    journaled(tmp_path, *range(5))
    ends = [end for end, _ in read(tmp_path)]
    assert [record for _, record in read(tmp_path, ends[1], ends[3])] == records(tmp_path)[2:4]


def test_a_full_disk_is_reported_leaves_the_committed_lines_whole_and_costs_none_later(tmp_path: Path) -> None:
    state = journaled(tmp_path, 1)
    journal = Journal(tmp_path)
    journal.load_state_dict(state)
    for step in range(2, 100):
        journal.metrics({"score": step}, step)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (state["offset"] + 100, hard))
    try:
        with pytest.raises(OSError, match="too large"):
            journal.state_dict()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (tmp_path / "journal.jsonl").stat().st_size > state["offset"]  # it broke off in the middle
    journal.commit()
    assert steps(tmp_path) == [1]
    journal.state_dict()
    journal.commit()
    assert steps(tmp_path) == list(range(1, 100))


def test_bytes_are_on_disk_before_their_name_and_lines_before_their_commit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tape: list[str] = []
    fsync, replace = os.fsync, os.replace

    def taped_fsync(descriptor: int) -> None:
        fsync(descriptor)
        tape.append("fsync " + os.path.relpath(os.readlink(f"/proc/self/fd/{descriptor}"), tmp_path))

    def taped_replace(source: Any, target: Any) -> None:
        replace(source, target)
        tape.append("name " + os.path.relpath(target, tmp_path))

    monkeypatch.setattr(os, "fsync", taped_fsync)
    monkeypatch.setattr(os, "replace", taped_replace)
    journal = Journal(tmp_path)
    journal.artifact("a", b"1")
    journal.state_dict()
    journal.commit()
    assert tape == [
        "fsync .",
        "fsync artifacts/a.aside",
        "name artifacts/a",
        "fsync artifacts",
        "fsync journal.jsonl",
        "fsync commit.json.aside",
        "name commit.json",
        "fsync .",
    ]


def test_a_file_that_cannot_be_written_leaves_the_one_before_it(tmp_path: Path) -> None:
    write_file(tmp_path / "a", b"before")
    with pytest.raises(TypeError):
        write_file(tmp_path / "a", "not bytes")  # type: ignore[arg-type]
    assert (tmp_path / "a").read_bytes() == b"before"


@pytest.mark.parametrize("goes_on", ["run", "snapshot"])
def test_a_run_and_its_snapshot_by_hard_links_both_go_on_without_the_other(tmp_path: Path, goes_on: str) -> None:
    run, snapshot = tmp_path / "run", tmp_path / "snapshot"
    with held(run, "run", 0.0):
        journaled(run, 1)
    shutil.copytree(run, snapshot, copy_function=os.link)
    folder, other = (run, snapshot) if goes_on == "run" else (snapshot, run)
    before = {path.name: path.read_bytes() for path in other.iterdir()}
    with held(folder, "run", 0.0):
        journal = Journal(folder)
        assert journal.resume()
        journal.metrics({"score": 2}, 2)
        journal.flush()
    assert steps(folder) == [1, 2]
    assert {path.name: path.read_bytes() for path in other.iterdir()} == before
    assert Journal(other).resume()


@pytest.mark.parametrize("name", ["journal.jsonl", "commit.json", "commit.json.aside", "holder.txt", "artifacts/file"])
def test_a_hard_link_in_a_run_folder_is_not_written_through(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "run"
    (tmp_path / "thesis").write_text("mine")
    (folder / "artifacts").mkdir(parents=True)
    os.link(tmp_path / "thesis", folder / name)
    with suppress(JournalError), held(folder, "run", 0.0):
        journal = Journal(folder)
        journal.artifact("file", b"theirs")
        journal.flush()
    assert (tmp_path / "thesis").read_text() == "mine"


@pytest.mark.parametrize("field", ["offset", "started", "updated"])
@pytest.mark.parametrize("number", [-5, 2**63, "1"])
def test_a_commit_out_of_range_is_refused(tmp_path: Path, field: str, number: int | str) -> None:
    journaled(tmp_path, 1)
    commit = json.loads((tmp_path / "commit.json").read_bytes())
    (tmp_path / "commit.json").write_text(json.dumps({**commit, field: number}))
    with pytest.raises(JournalError, match=r"commit\.json is damaged"):
        read_commit(tmp_path)


@pytest.mark.parametrize("name", ["journal.jsonl", "commit.json", "commit.json.aside", "artifacts"])
def test_a_link_in_a_run_folder_is_neither_read_nor_written_through(tmp_path: Path, name: str) -> None:
    folder, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    journaled(folder, 1)
    elsewhere.mkdir()
    (elsewhere / "file").write_text("mine")
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to(elsewhere if name == "artifacts" else elsewhere / "file")

    def write() -> None:
        journal = Journal(folder)
        journal.artifact("file", b"theirs")
        journal.flush()

    with pytest.raises((OSError, ValueError)):
        write()
    if name == "artifacts":
        with pytest.raises(ValueError, match="inside"):
            RunFolder(folder).artifact("file")
    assert [path.name for path in elsewhere.iterdir()] == ["file"]
    assert (elsewhere / "file").read_text() == "mine"


@pytest.mark.parametrize("path", ["/etc/passwd", "../journal.jsonl", "a/../../b", "link/x", "", "."])
def test_paths_out_of_the_artifacts_are_refused_in_writing_and_in_reading(tmp_path: Path, path: str) -> None:
    (tmp_path / "artifacts").mkdir()
    (tmp_path / "artifacts/link").symlink_to(tmp_path)
    journal = Journal(tmp_path)
    with pytest.raises(ValueError, match="inside"):
        journal.artifact(path, b"")
    journal.artifact("honest", b"")
    journal.state_dict()
    lines = (tmp_path / "journal.jsonl").read_text().replace('"honest"', json.dumps(path))
    (tmp_path / "journal.jsonl").write_text(lines)
    with pytest.raises(ValueError, match="inside"):
        list(read(tmp_path, 0, len(lines)))


def test_without_its_commit_a_journal_is_found_to_have_lost_it_and_its_whole_lines_count_again(tmp_path: Path) -> None:
    Journal(tmp_path).status("RUNNING")
    assert not has_lost_commit(tmp_path)
    journaled(tmp_path, *range(3))
    with open(tmp_path / "journal.jsonl", "ab") as file:
        file.write(b'{"kind":"metrics","step":3,"ti')
    assert not has_lost_commit(tmp_path)
    (tmp_path / "commit.json").unlink()
    assert has_lost_commit(tmp_path)
    adopt(tmp_path, tmp_path.parent)  # as a sweep does with a run that has yet to begin
    assert has_lost_commit(tmp_path)
    assert records(tmp_path) == []
    Journal(tmp_path).recover()
    commit = read_commit(tmp_path)
    assert commit is not None
    assert (commit.status, steps(tmp_path), has_lost_commit(tmp_path)) == ("FINISHED", [0, 1, 2], False)


def test_labels_and_errors_hold_from_the_first_moment_and_across_sessions(tmp_path: Path) -> None:
    Journal(tmp_path, {"mlflow.runName": "a", "group": "g"}).status("FAILED", "why")
    failed = read_commit(tmp_path)
    assert failed is not None
    assert (failed.offset, failed.status, failed.error) == (0, "FAILED", "why")
    Journal(tmp_path, {"mlflow.runName": "b"}).status("RUNNING")
    running = read_commit(tmp_path)
    assert running is not None
    assert (running.identity, running.error) == (failed.identity, "")
    assert running.labels == {"mlflow.runName": "b", "group": "g"}


def test_a_run_can_be_put_under_another_before_it_starts_and_after_it_ended(tmp_path: Path) -> None:
    run, first, second = (tmp_path / name for name in ("runs/run", "sweeps/first", "sweeps/second"))
    adopt(run, first)
    scheduled = read_commit(run)
    assert scheduled is not None
    assert (scheduled.status, scheduled.parent) == ("SCHEDULED", "../../sweeps/first")
    journal = Journal(run)
    journal.metrics({"score": 1.0}, 1)
    journal.state_dict()
    journal.commit()
    journal.status("FINISHED")
    ended = read_commit(run)
    adopt(run, second)
    adopted = read_commit(run)
    assert ended is not None
    assert adopted is not None
    assert ended.parent == "../../sweeps/first"
    assert (adopted.parent, adopted.updated, adopted.offset) == ("../../sweeps/second", ended.updated, ended.offset)
    assert (adopted.identity, adopted.status) == (scheduled.identity, "FINISHED")


def test_an_unknown_kind_of_record_is_named(tmp_path: Path) -> None:
    (tmp_path / "journal.jsonl").write_text('{"kind":"hologram"}\n')
    with pytest.raises(ValueError, match="hologram"):
        list(read(tmp_path, 0, 20))


def test_a_folder_without_a_journal_has_no_commit_and_no_records(tmp_path: Path) -> None:
    assert read_commit(tmp_path) is None
    assert records(tmp_path) == []


def test_the_curve_of_a_long_journal_is_some_of_its_points_with_both_ends(tmp_path: Path) -> None:
    journal = Journal(tmp_path)
    journal.tags({"note": '"score/mean":1 "frames":1'})
    for step in range(2_000):
        journal.metrics({"score/episode": step}, step)
        if 10 <= step < 1_900:
            journal.metrics({"score/mean": step / 2, "frames": step}, step)
    journal.state_dict()
    journal.commit()
    journal.metrics({"score/mean": 0.0, "frames": 0}, 2_000)
    journal.state_dict()
    whole = [record for _, record in read(tmp_path) if isinstance(record, Metrics) and "frames" in record.values]
    assert list(curve(tmp_path, ["frames", "score/mean"])) == whole
    for points in (1, 7, 50):
        some = list(curve(tmp_path, ["frames", "score/mean"], points))
        assert 0.9 * points <= len(some) <= points + 1
        assert (some[0], some[-1]) == (whole[0], whole[-1])
        steps = [record.step for record in some]
        assert steps == sorted(set(steps))
        assert max(np.diff(steps)) < 2.5 * 2_000 / points
        assert set(map(repr, some)) <= set(map(repr, whole))
    assert list(curve(tmp_path, ["missing"], 7)) == []
    (tmp_path / "journal.jsonl").write_bytes(b"{}")
    with pytest.raises(ValueError, match="before its commit"):
        list(curve(tmp_path, ["frames"], 7))
