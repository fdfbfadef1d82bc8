import errno
import itertools
import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from atlantis_exp.replay.memory import ReplayMemory, Returns
from atlantis_exp.runs.files import read_file
from atlantis_exp.runs.journal import read_commit
from atlantis_exp.training import checkpoint
from atlantis_exp.training.checkpoint import FORMAT, CheckpointError, Checkpoints, _checksum, unforged
from atlantis_exp.training.fingerprint import fingerprint
from atlantis_exp.training.trainer import Trainer

TREE = {
    "tensor": torch.arange(6).reshape(2, 3),
    "empty": torch.zeros(0, 3),
    "nested": {"scalar": np.float64(1.5), "array": np.ones((2, 2), np.uint8), "zero_d": np.array(3)},
    "big": 2**200,
    "none": None,
    "list": [1, 2.5, "x", True],
    "infinite": float("inf"),
}


def memory_of(observations: int, capacity: int = 640, *, of: ReplayMemory | None = None) -> ReplayMemory:
    memory = ReplayMemory(capacity, (8, 8), budget_bytes=2**20) if of is None else of  # an empty one is false
    rng = np.random.default_rng(memory.next_id)
    if memory.next_id == 0:
        memory.begin(0, np.zeros((8, 8), np.uint8))
    while memory.next_id < observations:
        memory.add(0, 1, 1.0, rng.integers(0, 255, (8, 8), np.uint8), False)
    return memory


def restored(folder: Path, capacity: int = 640) -> tuple[dict[str, Any] | None, ReplayMemory, list[str]]:
    memory, said = ReplayMemory(capacity, (8, 8), budget_bytes=2**20), list[str]()
    return Checkpoints(folder, "abc").load(memory, said.append), memory, said


def same(a: ReplayMemory, b: ReplayMemory) -> bool:
    return all(np.array_equal(value, b.state_dict()[name]) for name, value in a.state_dict().items())


@pytest.fixture
def two_generations(tmp_path: Path) -> Path:
    folder = tmp_path / "checkpoints"
    checkpoints = Checkpoints(folder, "abc")
    memory = memory_of(100)
    checkpoints.save({"step": 1, "weights": torch.ones(3), "array": np.zeros(2)}, memory)
    checkpoints.save({"step": 2, "weights": torch.ones(3), "array": np.zeros(2)}, memory_of(200, of=memory))
    return folder


def test_a_state_comes_back_as_it_was(tmp_path: Path) -> None:
    memory = memory_of(100)
    Checkpoints(tmp_path, "abc").save(TREE, memory)
    state, loaded, said = restored(tmp_path)
    assert state is not None
    assert said == []
    assert same(memory, loaded)
    assert state["tensor"].equal(TREE["tensor"])
    assert state["empty"].shape == (0, 3)
    nested = state["nested"]
    assert (nested["scalar"], nested["zero_d"].shape, nested["array"].dtype) == (1.5, (), np.uint8)
    assert {name: state[name] for name in ("big", "none", "list", "infinite")} == {
        name: TREE[name] for name in ("big", "none", "list", "infinite")
    }


def test_where_nothing_was_saved_there_is_nothing(tmp_path: Path) -> None:
    assert restored(tmp_path / "nowhere")[0] is None


def files_of(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


@pytest.mark.parametrize("damage", ["flip", "cut", "remove", "empty"])
def test_a_damaged_file_leads_to_the_generation_before_and_is_said(two_generations: Path, damage: str) -> None:
    newest = [name for name in files_of(two_generations) if name.startswith(("00000002", "segments/000000000100"))]
    assert len(newest) == 6
    for name in newest:
        copy = two_generations.with_name("copy")
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(two_generations, copy)
        content = bytearray((copy / name).read_bytes())
        if damage == "remove":
            (copy / name).unlink()
        else:
            content[len(content) // 2] ^= 1
            kept = {"flip": len(content), "cut": len(content) // 2, "empty": 0}[damage]
            (copy / name).write_bytes(content[:kept])
        state, memory, said = restored(copy)
        assert state is not None
        assert (state["step"], memory.next_id) == (1, 100)
        if (damage, name) != ("remove", "00000002/manifest.json"):  # without it there was no second generation
            assert len(said) == 1
            assert said[0].startswith(f"checkpoint 2 in {copy} is damaged (")
        again = Checkpoints(copy, "abc")
        again.load(memory)
        again.save({"step": 2}, memory_of(200, of=memory))
        assert restored(copy)[0] == {"step": 2}


@pytest.mark.parametrize(
    "error", [OSError(errno.ESTALE, "Stale file handle"), PermissionError(13, "no"), MemoryError()]
)
def test_what_cannot_be_read_now_is_no_damage(
    two_generations: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    """Else the run would go on without it, and the next commit would remove it."""
    before = files_of(two_generations)
    for name in before:

        def refused(path: Path, most: int, name: str = name) -> bytes:
            if path.match(name):
                raise error
            return read_file(path, most)

        if not name.startswith("00000001"):  # which is not read as long as there is a newer one
            monkeypatch.setattr(checkpoint, "read_file", refused)
            with pytest.raises(CheckpointError, match=r"cannot be read now \(.+\), but may be whole"):
                restored(two_generations)
    monkeypatch.undo()
    assert files_of(two_generations) == before
    state, _, said = restored(two_generations)
    assert state is not None
    assert (state["step"], said) == (2, [])


@pytest.mark.parametrize("error", [PermissionError(13, "no"), MemoryError()])
def test_what_cannot_be_read_now_is_no_damage_either_where_something_else_is(
    two_generations: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    (oldest, *_) = [name for name in files_of(two_generations) if name.startswith("segments/")]
    (two_generations / oldest).write_bytes(b"")
    outcomes = []
    for whole in range(30):
        files = itertools.count()

        def refused(path: Path, most: int, whole: int = whole, files: Iterator[int] = files) -> bytes:
            if next(files) >= whole:
                raise error
            return read_file(path, most)

        monkeypatch.setattr(checkpoint, "read_file", refused)
        with suppress(CheckpointError):
            outcomes.append(restored(two_generations)[2][-1])
    assert 0 < len(outcomes) < 30
    assert {*outcomes} == {"no checkpoint has its whole replay memory: 100 observations are lost, the run continues"}


def test_a_part_that_the_memory_has_no_room_for_is_one_line(
    two_generations: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checkpoint, "read_file", lambda *_: bytearray(2**62))
    with pytest.raises(CheckpointError, match="not enough memory"):
        restored(two_generations)


def test_a_flipped_bit_of_a_manifest_is_noticed(two_generations: Path) -> None:
    path = two_generations / "00000002/manifest.json"
    content = path.read_bytes()
    for position in range(0, len(content), 7):
        path.write_bytes(content[:position] + bytes([content[position] ^ 1 << position % 8]) + content[position + 1 :])
        state = restored(two_generations)[0]
        assert state is not None
        assert state["step"] == 1


def test_where_every_generation_is_damaged_the_error_says_so(two_generations: Path) -> None:
    for path in two_generations.glob("0*/state.json"):
        path.write_bytes(b"{}")
    with pytest.raises(CheckpointError, match=r"checkpoint 2 .* is damaged .*, and no older one is whole"):
        restored(two_generations)


def test_a_checkpoint_of_another_experiment_or_a_newer_format_is_refused(two_generations: Path) -> None:
    with pytest.raises(CheckpointError, match="belongs to experiment abc, not to xyz"):
        Checkpoints(two_generations, "xyz").load()
    path = two_generations / "00000002/manifest.json"
    manifest = json.loads(path.read_bytes())
    del manifest["sha256"]
    manifest["format"] = 2
    path.write_text(json.dumps({**manifest, "sha256": _checksum(manifest)}))
    with pytest.raises(CheckpointError, match="format 2, this version reads up to 1"):
        restored(two_generations)


def test_a_manifest_that_names_files_elsewhere_is_not_followed(two_generations: Path) -> None:
    (two_generations.parent / "secret").mkdir()
    path = two_generations / "00000002/manifest.json"
    for state, segment in (({"../secret": "0"}, "segments/x"), ({}, "../secret")):
        manifest = {"format": FORMAT, "identity": "abc", "state": state, "segments": [{"name": segment, "sha256": {}}]}
        path.write_text(json.dumps({**manifest, "sha256": _checksum(manifest)}))
        found, _, said = restored(two_generations)
        assert found is not None
        assert found["step"] == 1
        assert "is damaged" in said[0]


def test_a_save_writes_only_observations_that_are_new(tmp_path: Path) -> None:
    checkpoints, memory = Checkpoints(tmp_path, "abc"), memory_of(1)
    written = []
    for observations in range(50, 2_000, 50):
        checkpoints.save({}, memory_of(observations, of=memory))
        written.append(sum(path.stat().st_size for path in tmp_path.glob("segments/*/*")))
        assert same(restored(tmp_path)[1], memory)
    assert max(written) < 3 * min(written[20:])  # what the memory forgot is removed


def test_frequent_saves_leave_no_crumbs(tmp_path: Path) -> None:
    checkpoints, memory = Checkpoints(tmp_path, "abc"), memory_of(1)
    for observations in range(2, 400, 2):
        checkpoints.save({}, memory_of(observations, of=memory))
    assert len(list(tmp_path.glob("segments/*"))) <= 64 + 3
    assert len(list(tmp_path.glob("0*"))) == 2
    (tmp_path / "00000200").mkdir()
    (tmp_path / "00000200/tensors.safetensors").touch()  # of a save that a crash ended
    checkpoints.save({}, memory)
    assert files_of(tmp_path / "00000200") == ["manifest.json", "state.json"]
    assert same(restored(tmp_path)[1], memory)


def test_the_generation_before_the_newest_has_its_whole_memory_whatever_the_newest_shares_of_it(tmp_path: Path) -> None:
    checkpoints, memory, before = Checkpoints(tmp_path, "abc"), memory_of(1), None
    for end in (3, 5, 40, 44, 300, 640, 645, 700, 1_500, 1_503):  # some rewrite a segment, some forget one
        checkpoints.save({"step": end}, memory_of(end, of=memory))
        newest = max(tmp_path.glob("0*/manifest.json"))
        aside = newest.rename(newest.with_name("aside"))
        state, older, said = restored(tmp_path)
        aside.rename(newest)
        if before is not None:
            assert (state, said) == ({"step": before["step"]}, [])
            assert all(np.array_equal(value, before[name]) for name, value in older.state_dict().items())
        before = {"step": end, **memory.state_dict()}


def test_a_save_that_the_disk_refuses_leaves_the_last_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoints, memory = Checkpoints(tmp_path, "abc"), memory_of(100)
    checkpoints.save({"step": 1}, memory)
    memory_of(200, of=memory)
    synced = os.fsync
    for allowed in range(8):
        calls = iter(range(allowed))

        def full(file: int, calls: Any = calls) -> None:
            if next(calls, None) is None:
                raise OSError(28, "No space left on device")
            synced(file)

        with monkeypatch.context() as patched:
            patched.setattr(os, "fsync", full)
            with pytest.raises(OSError, match="No space left"):
                checkpoints.save({"step": 2, "weights": torch.ones(3)}, memory)
        state = restored(tmp_path)[0]
        if state != {"step": 1}:
            assert allowed == 7  # only the folder's own sync came after the manifest
    checkpoints.save({"step": 2}, memory)
    assert restored(tmp_path)[0] == {"step": 2}


def die_in_commit(trainer: Trainer, folder: Path, operation: int) -> bool:
    """Commit to a folder in a forked process that dies before its n-th file operation; False if it had no n-th."""
    if (child := os.fork()) == 0:
        try:
            _commit_and_die(trainer, folder, operation)
        finally:
            os._exit(1)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert status in (0, 9)
    return status == 9


def _commit_and_die(trainer: Trainer, folder: Path, operation: int) -> None:
    trainer.checkpoints.folder = folder / "checkpoints"
    trainer.recorder.journal._folder = folder
    count = 0

    def tick(event: str, _: object = None) -> None:
        nonlocal count
        if event in ("open", "fsync", "os.rename", "os.mkdir", "os.remove", "os.rmdir"):
            count += 1
            if count > operation:
                os._exit(9)

    synced = os.fsync

    def sync(file: int) -> None:
        tick("fsync")
        synced(file)

    os.fsync = sync  # type: ignore[assignment]
    sys.addaudithook(tick)
    trainer.commit()
    os._exit(0)


@pytest.mark.slow
@pytest.mark.parametrize("continued", [pytest.param(False, id="loaded"), pytest.param(True, id="continued")])
def test_a_death_at_any_file_operation_of_a_commit_leaves_the_commit_before_or_this_one(
    small: Callable[..., Trainer], tmp_path: Path, continued: bool
) -> None:
    def begun(folder: Path) -> Trainer:
        return small(folder, evaluate_steps=None)

    def sessions(trainer: Trainer, *steps: int) -> None:
        for goal in steps:
            assert trainer.run(lambda goal=goal: trainer.counters.steps == goal) == "interrupted"  # type: ignore[misc]

    dying = begun(tmp_path / "base")
    sessions(dying, 60, 100)
    dying.commit = lambda: None  # type: ignore[method-assign]
    sessions(dying, 160)
    del dying.commit  # the class has it
    unbroken = begun(tmp_path / "unbroken")
    unbroken.run()
    goal = fingerprint(unbroken.state_dict(), unbroken.memory, tmp_path / "unbroken")

    steps: list[int] = []
    while True:
        folder = tmp_path / f"death-{len(steps)}"
        shutil.copytree(tmp_path / "base", folder)
        if not die_in_commit(dying, folder, len(steps)):
            break
        memory = ReplayMemory(dying.memory.capacity, (8, 8), budget_bytes=2**20)
        checkpoints = Checkpoints(folder / "checkpoints", dying.checkpoints.identity)
        state, mark = checkpoints.load(memory), read_commit(folder)
        assert state is not None
        assert mark is not None
        assert mark.offset <= state["tracker"]["offset"]  # nothing is shown that no checkpoint backs
        steps.append(state["counters"]["steps"])
        if continued:
            after = begun(folder)
            after.run()
            assert fingerprint(after.state_dict(), after.memory, folder) == goal
    assert steps == sorted(steps)
    assert set(steps) == {100, 160}
    assert len(steps) > 20


def test_a_state_that_is_none_of_this_training_is_one_line_with_the_reason(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"\(KeyError: 'weights'\)"), unforged(tmp_path):
        dict[str, int]()["weights"]


@pytest.mark.parametrize(
    ("capacity", "damaged", "oldest", "lost"),
    [(640, "000000000000", 100, 100), (640, "000000000100", 150, 150), (180, "000000000000", 100, 80)],
)
def test_where_a_segment_that_generations_share_is_damaged_the_observations_behind_it_go_on(
    tmp_path: Path, capacity: int, damaged: str, oldest: int, lost: int
) -> None:
    checkpoints, memory = Checkpoints(tmp_path, "abc"), memory_of(100, capacity)
    for step, end in enumerate((100, 150, 200), start=1):
        checkpoints.save({"step": step}, memory_of(end, of=memory))
    [path] = tmp_path.glob(f"segments/{damaged}*/arrays.safetensors")
    path.write_bytes(b"")
    state, loaded, said = restored(tmp_path, capacity)
    assert state == {"step": 3}
    assert (loaded.oldest_id, loaded.next_id) == (oldest, 200)
    ids = np.flatnonzero(loaded.available(np.arange(200)))
    assert len(ids) == len(loaded) > 0
    ours, theirs = (each.gather(ids, Returns(0.9)) for each in (loaded, memory))
    assert all(np.array_equal(getattr(ours, name), getattr(theirs, name)) for name in ours._fields)
    assert said[-1] == f"no checkpoint has its whole replay memory: {lost} observations are lost, the run continues"
    goes_on, last = Checkpoints(tmp_path, "abc"), ReplayMemory(capacity, (8, 8), budget_bytes=2**20)
    goes_on.load(last)
    goes_on.save({"step": 4}, memory_of(250, of=last))
    state, again, said = restored(tmp_path, capacity)
    assert (state, said, same(again, last)) == ({"step": 4}, [], True)
