"""Write files of run folders whole, and read them within limits: anybody may have written them.

Follow no symbolic link and write through no hard link, since both lead to another folder's files.
"""

import errno
import hashlib
import os
import shutil
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, BinaryIO, TypeVar

from pydantic import Field, TypeAdapter, ValidationError
from pydantic_core import from_json

from atlantis_exp.faults import Fault

T = TypeVar("T")

Natural = Annotated[int, Field(ge=0, lt=2**63)]

SMALL = 2**24  # bytes; a table of 20,000 episodes has 2 MB, other texts of a run a few KB
ARTIFACT = 2**30  # bytes, of a film or a network
CHECKPOINT = 2**36  # bytes, of a whole replay memory

_schemas: dict[Any, TypeAdapter[Any]] = {}


def schema_of(kind: type[T]) -> TypeAdapter[T]:
    """Return the pydantic schema of a class, built on first use: all at import would take 0.1 s."""
    if kind not in _schemas:
        _schemas[kind] = TypeAdapter(kind)
    return _schemas[kind]


def checked(kind: type[T], values: Mapping[str, Any]) -> T:
    """Make an instance of a class from plain values. Raises: ValueError with one line."""
    try:
        return schema_of(kind).validate_python(values)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        raise ValueError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None


def open_file(path: Path) -> BinaryIO:
    """Open a regular file for reading. Raises: OSError; ValueError for another kind of file."""
    try:
        file = open(path, "rb", opener=no_link)  # noqa: SIM115
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise ValueError(f"{path} is a link, not a regular file") from None
        raise
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise ValueError(f"{path} is not a regular file")
    return file


def read_file(path: Path, most: int) -> bytes:
    """Return the content of a regular file of at most `most` bytes. Raises: OSError, ValueError."""
    with open_file(path) as file:
        if (size := os.fstat(file.fileno()).st_size) > most:
            raise ValueError(f"{path} has {size:,} bytes, more than {most:,}")
        return file.read()


def no_link(path: str, flags: int) -> int:
    """Open a file, as `opener` of `open`: refuse symbolic links, cut hard links before writing, wait for no pipe."""
    if flags & (os.O_WRONLY | os.O_RDWR):
        own(Path(path))
    return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)


def own(path: Path) -> None:
    """Replace a regular file that has a second name, as after `cp -al`, by a copy. Raises: OSError."""
    with suppress(FileNotFoundError):
        found = path.lstat()
        if stat.S_ISREG(found.st_mode) and found.st_nlink > 1:
            aside = path.with_name(path.name + ".own")
            aside.unlink(missing_ok=True)
            shutil.copy2(path, aside)
            aside.replace(path)


def inside(folder: Path, path: str) -> Path:
    """Return the file at a path in a run's folder. Raises: ValueError if it leads out of the folder."""
    root = folder.parent.resolve() / folder.name
    file = (root / path).resolve()
    if root not in file.parents:
        raise ValueError(f"The path {path!r} does not name a file inside {root}")
    return file


def is_whole(content: bytes, sha256: str) -> bool:
    """Return whether content has a checksum; an empty one, of 0.1.0, fits any content."""
    return sha256 in ("", hashlib.sha256(content).hexdigest())


def read_object(content: bytes) -> dict[str, Any]:
    """Parse a JSON object. Raises: ValueError, also for too deep nesting."""
    tree = from_json(content)  # bounds the depth; `json` would raise RecursionError
    if not isinstance(tree, dict):
        raise ValueError(f"should be an object, is {type(tree).__name__}")
    return tree


def make_folder(folder: Path) -> None:
    """Make a folder and its missing parents durable."""
    if not folder.is_dir():
        make_folder(folder.parent)
        folder.mkdir(exist_ok=True)
        _sync(folder.parent)


def write_file(path: Path, content: bytes) -> None:
    """Write a file whole and durably, or not at all. Raises: OSError."""
    make_folder(path.parent)
    aside = path.with_name(path.name + ".aside")
    with open(aside, "wb", opener=no_link) as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    aside.replace(path)
    _sync(path.parent)


@contextmanager
def whole(folder: Path) -> Iterator[Path]:
    """Yield a folder to fill, which becomes the folder of `to=` if the block succeeds. Raises: Fault for an OSError."""
    try:
        make_folder(folder.parent)
        with TemporaryDirectory(prefix=".aside-", dir=folder.parent, ignore_cleanup_errors=True) as place:
            make_folder(aside := Path(place) / folder.name)
            yield aside
            aside.replace(folder)
        _sync(folder.parent)
    except OSError as error:
        raise Fault(f"to={folder}: {error}; nothing is written; make room there, or name another folder") from error


def _sync(folder: Path) -> None:
    """Make the names in a folder durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
