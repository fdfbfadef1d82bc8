"""Texts on a terminal as they are, where a name with brackets is no markup; what is under way, and durations."""

import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from io import TextIOWrapper
from itertools import count
from pathlib import Path
from typing import Any, TextIO

from rich.console import Console
from rich.text import Text

_HERE = Path(__file__).parent
PROGRAM = "atlantis-exp" if (_HERE / "conf").is_dir() else "python -m atlantis_exp"
"""What a person calls: an installed wheel, which brings the config groups, by the name of its command."""
LINE_SECONDS = 4.0  # before the first line of what is under way: nothing begins with five seconds of silence
_documents: list[str] | None = None  # to be printed, while nothing else may be
_FIRST_SECONDS = 1.0  # what takes less needs no line


class _Harmless:
    """A stream that leaves out what a terminal would obey, whatever is printed to it."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        return self.stream.write(harmless(text))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


class _Console(Console):
    """A console that shows texts as they are, and sends codes of its own alone."""

    def __init__(self, **settings: Any) -> None:
        file = sys.stdout.stream if isinstance(sys.stdout, _Harmless) else sys.stdout
        super().__init__(file=file, highlight=False, markup=False, emoji=False, **settings)

    def render_str(self, text: str, **settings: Any) -> Text:
        return super().render_str(harmless(text), **settings)


def guard() -> None:
    """Have stdout and stderr leave out what a terminal would obey, and write in any encoding."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if not isinstance(stream, _Harmless):
            if isinstance(stream, TextIOWrapper):
                stream.reconfigure(errors="backslashreplace")
            setattr(sys, name, _Harmless(stream))


def console(least: int | None = None) -> Console:
    """Return a console; least: columns of a table that would be cut on a narrower one, None to keep lines whole."""
    if least is None:
        return _Console(soft_wrap=True)
    return _Console(width=max(shutil.get_terminal_size().columns, least))


def harmless(text: str) -> str:
    """Return a text without what a terminal would obey: its lines of printable characters."""
    return "".join(character for character in text if character == "\n" or character.isprintable())


def warn(text: str) -> None:
    """Print one line on stderr."""
    print(f"atlantis_exp: {harmless(text)}".replace("\n", " "), file=sys.stderr, flush=True)


@contextmanager
def only_documents() -> Iterator[None]:
    """Send to stderr all that this process and those it starts print, except documents."""
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
    """Have a verb's answer printed, one line of JSON, where documents are asked for."""
    if _documents is not None:
        _documents.append(text)


def until_line(lines: int) -> float:
    """Return the seconds before the next line of what is under way, after so many: 4, 8, 16, then 30 each."""
    return min(LINE_SECONDS * 2.0 ** min(lines, 3), 30.0)


@contextmanager
def working(what: str, how_far: Callable[[], str] = str) -> Iterator[None]:
    """Say what is under way, and how far: in a changing line on a terminal, elsewhere in a line every few seconds.

    how_far is asked for each line, in another thread.
    """
    shown, began, ended = console(), time.monotonic(), threading.Event()

    def line() -> str:
        return harmless(", ".join(filter(None, (what, how_far(), f"{time.monotonic() - began:.0f} s"))))

    def tell() -> None:
        if ended.wait(_FIRST_SECONDS):
            return
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
    """A duration as hours, minutes and seconds, 26:07:09; what is below zero is zero."""
    minutes, second = divmod(max(int(seconds), 0), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{second:02}"
