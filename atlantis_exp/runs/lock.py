"""Lock a folder for one process at a time, until it ends in any way."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from atlantis_exp.faults import Fault
from atlantis_exp.runs.files import SMALL, make_folder, no_link, open_file, read_file

_HOLDER = "holder.txt"  # not the lock itself, which each attempt empties
_OF_OPTUNA = "trials.jsonl.lock"  # a link while a process writes


@contextmanager
def held(folder: Path, name: str, seconds: float) -> Iterator[None]:
    """Lock a folder, created if needed, for the block; wait up to `seconds` for it.

    Raises:
        Fault: another process holds it (exit code 75), or it contains a symbolic link.
    """
    if (link := _link(folder)) is not None:
        raise Fault(f"{name}: {link} is a link; replace it by a copy of its target")
    make_folder(folder)
    try:
        lock = FileLock(folder / "lock").acquire(seconds)
    except Timeout:
        raise Fault(f"{name} is held by {_holder(folder)}", exit_code=75) from None
    with lock:
        with open(folder / _HOLDER, "w", opener=no_link) as file:
            file.write(f"process {os.getpid()} on {os.uname().nodename}\n")
        yield


def _holder(folder: Path) -> str:
    try:
        return read_file(folder / _HOLDER, SMALL).decode().strip()
    except (OSError, ValueError):
        return "another process"


def _link(folder: Path) -> Path | None:
    """Find a symbolic link: the folder itself or one in it, except Optuna's lock of a search."""
    places = (Path(above, name) for above, folders, files in os.walk(folder) for name in (*folders, *files))
    links = (path for path in (folder, *places) if path.is_symlink())
    return next((link for link in links if link != folder / _OF_OPTUNA), None)


def is_held(folder: Path) -> bool:
    """Return whether a process holds a folder, which may be read-only. Raises: OSError."""
    try:
        with open_file(folder / "lock") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)  # until it is closed
            return False
    except (FileNotFoundError, ValueError):
        return False
    except BlockingIOError:
        return True


@contextmanager
def alone(path: Path) -> Iterator[None]:
    """Wait for a lock file, and keep other processes out of the block."""
    make_folder(path.parent)
    with FileLock(path):
        yield
