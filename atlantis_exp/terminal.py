"""Print to a terminal: texts without markup or control characters, work in progress, durations."""

import os
import re
import shlex
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from io import TextIOWrapper
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from rich.console import Console
from rich.text import Text

if TYPE_CHECKING:
    from rich.table import Table

_HERE = Path(__file__).parent
PROGRAM = "atlantis-exp" if (_HERE / "conf").is_dir() else "python -m atlantis_exp"
"""The command to type: an installed wheel has a script and the config groups, a checkout the module."""
LINE_SECONDS = 4.0  # before the first line about work in progress
_documents: list[str] | None = None  # collected by `only_documents`
_FIRST_SECONDS = 1.0  # shorter work is not shown


class _Harmless:
    """A stream that drops control characters."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        return self.stream.write(harmless(text))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


class _Console(Console):
    """A console without markup; only its own control codes reach the terminal."""

    def __init__(self, **settings: Any) -> None:
        file = sys.stdout.stream if isinstance(sys.stdout, _Harmless) else sys.stdout
        super().__init__(file=file, highlight=False, markup=False, emoji=False, **settings)

    def render_str(self, text: str, **settings: Any) -> Text:
        return super().render_str(harmless(text), **settings)


def guard() -> None:
    """Make stdout and stderr drop control characters and work in any encoding."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name) or open(os.devnull, "w")  # noqa: SIM115, for good; a supervisor has closed it
        if not isinstance(stream, _Harmless):
            if isinstance(stream, TextIOWrapper):
                stream.reconfigure(errors="backslashreplace")
            setattr(sys, name, _Harmless(stream))


def console(least: int | None = None) -> Console:
    """Return a console of at least `least` columns, for a table; None does not wrap lines."""
    if least is None:
        return _Console(soft_wrap=True)
    return _Console(width=max(shutil.get_terminal_size().columns, least))


def table(*columns: str, title: str | None = None) -> "Table":
    """Return a table whose first column is left-justified, the others right-justified."""
    from rich.table import Column, Table  # most commands print none

    return Table(columns[0], *(Column(each, justify="right") for each in columns[1:]), title=title)


def harmless(text: str) -> str:
    """Return a text without control characters other than newlines."""
    return "".join(character for character in text if character == "\n" or character.isprintable())


def command_line(*arguments: str) -> str:
    """Return one of our commands, quoted for a shell."""
    return " ".join((PROGRAM, *map(shlex.quote, arguments)))


def quoted(value: object) -> str:
    """Return the text of a value, quoted for Hydra if needed."""
    text = str(value)
    if re.fullmatch(r"(?!(null|true|false|nan|inf)$)([a-z_]|\.{0,2}/)[\w/.+:%@-]*", text, re.ASCII | re.IGNORECASE):
        return text
    return '"' + re.sub(r'(\\*)("|$)', lambda match: match[1] * 2 + match[2].replace('"', r"\""), text) + '"'


def warn(text: str) -> None:
    """Print one line on stderr."""
    print(f"atlantis_exp: {harmless(text)}".replace("\n", " "), file=sys.stderr, flush=True)


@contextmanager
def only_documents() -> Iterator[None]:
    """Redirect to stderr all output of this process and its children, except documents."""
    global _documents
    sys.stdout.flush()
    kept, _documents = os.dup(1), []
    os.dup2(2, 1)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        texts, _documents = _documents, None
        for text in texts:
            console().print(text)


def document(text: str) -> None:
    """Print a verb's answer, one line of JSON, when `only_documents` ends; without it print nothing."""
    if _documents is not None:
        _documents.append(text)


def until_line(lines: int) -> float:
    """Return the seconds before the next line about work in progress: 4, 8, 16, then 30."""
    return min(LINE_SECONDS * 2.0 ** min(lines, 3), 30.0)


@contextmanager
def working(what: str, how_far: Callable[[], str] = str) -> Iterator[None]:
    """Show work in progress: a changing line on a terminal, a line every few seconds elsewhere.

    how_far: called for each line, in another thread.
    """
    shown, began, ended = console(), time.monotonic(), threading.Event()

    def line() -> str:
        return harmless(", ".join(filter(None, (what, how_far(), f"{time.monotonic() - began:.0f} s"))))

    def tell() -> None:
        if ended.wait(_FIRST_SECONDS):
            return
        with suppress(OSError):  # of a full disk; the work goes on
            if not shown.is_terminal:
                shown.print(line())
                for lines in count():
                    if ended.wait(until_line(lines)):
                        return
                    shown.print(line())
            with shown.status(line()) as status:
                while not ended.wait(0.25):
                    status.update(line())

    thread = threading.Thread(target=tell, name="telling", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def clock(seconds: float) -> str:
    """Return a duration as hours, minutes and seconds: 26:07:09; 0 for a negative one."""
    minutes, second = divmod(max(int(seconds), 0), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{second:02}"
