"""Files of run folders: put in place whole, and read within bounds, since whatever is read may be anybody's.

No link is followed: it would lead to a file of whoever reads or writes here.
"""

import errno
import hashlib
import os
import stat
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from pydantic import TypeAdapter
from pydantic_core import from_json

T = TypeVar("T")

SMALL = 2**24  # bytes; what a run says of itself has some kilobytes, a table of 20,000 episodes two megabytes
ARTIFACT = 2**30  # bytes, of a film or a network
CHECKPOINT = 2**36  # bytes, of a whole replay memory

_schemas: dict[Any, TypeAdapter[Any]] = {}


def schema_of(kind: type[T]) -> TypeAdapter[T]:
    """What checks and makes instances of a class; built at first need, as all together take a tenth of a second."""
    if kind not in _schemas:
        _schemas[kind] = TypeAdapter(kind)
    return _schemas[kind]


def open_file(path: Path) -> BinaryIO:
    """Open a regular file for reading. Raises: OSError, ValueError where it is of another kind."""
    try:
        file = open(path, "rb", opener=no_link)  # noqa: SIM115
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise ValueError(f"{path} is no regular file, but a link") from None
        raise
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise ValueError(f"{path} is no regular file")
    return file


def read_file(path: Path, most: int) -> bytes:
    """The content of a regular file of at most so many bytes. Raises: OSError, ValueError."""
    with open_file(path) as file:
        if (size := os.fstat(file.fileno()).st_size) > most:
            raise ValueError(f"{path} has {size:,} bytes, more than {most:,}")
        return file.read()


def no_link(path: str, flags: int) -> int:
    """Open a file that is no symbolic link, as `opener` of `open`. Raises: OSError.

    A pipe does not block: it would wait until somebody comes to its other end.
    """
    return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)


def inside(folder: Path, path: str) -> Path:
    """The file in a folder of a run that a path names. Raises: ValueError where it, or a link, leads out of it."""
    root = folder.parent.resolve() / folder.name
    file = (root / path).resolve()
    if root not in file.parents:
        raise ValueError(f"The path {path!r} does not name a file inside {root}")
    return file


def is_whole(content: bytes, sha256: str) -> bool:
    """Whether a content has a checksum; an empty one, as 0.1.0 left it, is not known."""
    return sha256 in ("", hashlib.sha256(content).hexdigest())


def read_object(content: bytes) -> dict[str, Any]:
    """The object that JSON holds, of bounded depth. Raises: ValueError."""
    tree = from_json(content)  # has a bound of its own, where `json` ends in RecursionError
    if not isinstance(tree, dict):
        raise ValueError(f"should be an object, is {type(tree).__name__}")
    return tree


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, where they are missing, durably."""
    if not folder.is_dir():
        make_folder(folder.parent)
        folder.mkdir(exist_ok=True)
        _sync(folder.parent)


def write_file(path: Path, content: bytes) -> None:
    """Put a file in place whole, durably, or not at all."""
    make_folder(path.parent)
    aside = path.with_name(path.name + ".aside")
    with open(aside, "wb", opener=no_link) as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    aside.replace(path)
    _sync(path.parent)


def _sync(folder: Path) -> None:
    """Make durable which names are in a folder."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
