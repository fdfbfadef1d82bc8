"""Who holds a folder, told by and to other processes."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path

import pytest

from atlantis_exp.faults import Fault
from atlantis_exp.runs.files import write_file
from atlantis_exp.runs.lock import alone, held, is_held

REPOSITORY = Path(__file__).parents[2]
HOLDER = """
import sys
from pathlib import Path
from atlantis_exp.runs.lock import held
with held(Path(sys.argv[1]), "run x", 0):
    print("held", flush=True)
    sys.stdin.read()
"""


@contextmanager
def holder(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that holds a folder until its input ends, or it does."""
    command = (sys.executable, "-c", HOLDER, folder)
    with subprocess.Popen(command, cwd=REPOSITORY, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        yield process


def test_a_folder_that_another_process_holds_is_refused_with_its_name(tmp_path: Path) -> None:
    with holder(tmp_path) as process:
        assert is_held(tmp_path)
        with pytest.raises(Fault) as refused, held(tmp_path, "run y", 0.0):
            pass
        assert str(refused.value) == f"run y is held by process {process.pid} on {os.uname().nodename}"
        assert refused.value.exit_code == 75
        assert is_held(tmp_path)  # to ask does not take it away
    assert process.returncode == 0
    assert not is_held(tmp_path)


def test_pipes_in_the_place_of_its_files_hold_nobody_up(tmp_path: Path) -> None:
    with holder(tmp_path):
        (tmp_path / "holder.txt").unlink()
        os.mkfifo(tmp_path / "holder.txt")
        with pytest.raises(Fault, match=r"^run y is held by another process$"), held(tmp_path, "run y", 0.0):
            pass
    with pytest.raises(OSError, match=r"holder\.txt"), held(tmp_path, "run y", 0.0):
        pass
    (tmp_path / "lock").unlink()
    os.mkfifo(tmp_path / "lock")
    assert not is_held(tmp_path)
    os.mkfifo(tmp_path / "x.aside")
    with pytest.raises(OSError, match=r"x\.aside"):
        write_file(tmp_path / "x", b"")


@pytest.mark.parametrize("link", ["", "checkpoints", "a/b/c", "published.lock"])
def test_a_folder_with_a_link_is_not_held_for_writing(tmp_path: Path, link: str) -> None:
    folder, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    elsewhere.mkdir()
    (folder / link).parent.mkdir(parents=True, exist_ok=True)
    (folder / link).symlink_to(elsewhere)
    with pytest.raises(Fault, match=f"run x: {folder / link} is a link"), held(folder, "run x", 0.0):
        pass
    assert not list(elsewhere.iterdir())


def test_a_lock_is_not_opened_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("my work")
    (tmp_path / "published.lock").symlink_to("thesis.txt")
    with pytest.raises(OSError, match=r"published\.lock"), alone(tmp_path / "published.lock"):
        pass
    assert (tmp_path / "thesis.txt").read_text() == "my work"


def test_the_lock_that_optuna_has_in_a_search_is_no_link_of_others(tmp_path: Path) -> None:
    (tmp_path / "trials.jsonl.lock").symlink_to("trials.jsonl")
    with held(tmp_path, "search x", 0.0):
        pass


def test_a_folder_is_free_once_its_holder_is_killed(tmp_path: Path) -> None:
    with holder(tmp_path) as process:
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        assert not is_held(tmp_path)
        with held(tmp_path, "run x", 0.0):
            assert is_held(tmp_path)
            assert (tmp_path / "holder.txt").read_text() == f"process {os.getpid()} on {os.uname().nodename}\n"


def test_a_folder_is_waited_for(tmp_path: Path) -> None:
    with holder(tmp_path) as process:
        assert process.stdin is not None
        threading.Timer(0.2, process.stdin.close).start()
        with held(tmp_path, "run x", 60.0):
            assert is_held(tmp_path)


def test_a_folder_is_held_against_this_process_too_until_the_block_ends_however_it_does(tmp_path: Path) -> None:
    folder = tmp_path / "runs" / "x"
    assert not is_held(folder)
    assert not folder.exists()  # to ask makes no folder
    with suppress(KeyError), held(folder, "run x", 0.0):
        assert is_held(folder)
        with pytest.raises(Fault, match=f"process {os.getpid()} "), held(folder, "run x", 0.0):
            pass
        raise KeyError
    assert not is_held(folder)


@pytest.mark.parametrize(
    "hold",
    [lambda path: held(path, "run x", 0.0), lambda path: alone(path / "by.lock")],
    ids=["held", "alone"],
)
def test_the_names_of_folders_made_for_a_lock_are_on_disk(
    hold: Callable[[Path], AbstractContextManager[None]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tape: list[str] = []
    fsync = os.fsync

    def taped_fsync(descriptor: int) -> None:
        fsync(descriptor)
        tape.append(os.path.relpath(os.readlink(f"/proc/self/fd/{descriptor}"), tmp_path))

    monkeypatch.setattr(os, "fsync", taped_fsync)
    with hold(tmp_path / "a" / "b"):
        assert tape[:2] == [".", "a"]


def test_those_who_want_to_be_alone_come_one_after_the_other(tmp_path: Path) -> None:
    inside, most = 0, 0

    def work() -> None:
        nonlocal inside, most
        for _ in range(5):
            with alone(tmp_path / "made" / "by.lock"):
                inside += 1
                most = max(most, inside)
                time.sleep(0.001)  # or else nobody comes in between
                inside -= 1

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (inside, most) == (0, 1)
