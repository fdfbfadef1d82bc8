"""Texts on a terminal as they are, where a name with brackets is no markup; what is under way, and durations."""

import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

from rich.console import Console

_HERE = Path(__file__).parent
PROGRAM = "atlantis-exp" if (_HERE / "conf").is_dir() else "python -m atlantis_exp"
"""What a person calls: an installed wheel, which brings the config groups, by the name of its command."""
LINE_SECONDS = 4.0  # before the first line of what is under way: nothing begins with five seconds of silence
_FIRST_SECONDS = 1.0  # what takes less needs no line


def console(least: int | None = None) -> Console:
    """A console; least: columns of a table that would be cut on a narrower one, None to leave long lines to it."""
    if least is None:
        return Console(highlight=False, markup=False, emoji=False, soft_wrap=True)
    width = max(shutil.get_terminal_size().columns, least)
    return Console(highlight=False, markup=False, emoji=False, width=width)


def harmless(text: str) -> str:
    """A stored text without what a terminal would obey: its lines of printable characters."""
    return "".join(character for character in text if character == "\n" or character.isprintable())


def warn(text: str) -> None:
    """Print one line on stderr, without what a terminal would obey."""
    print(f"atlantis_exp: {harmless(text)}".replace("\n", " "), file=sys.stderr, flush=True)


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
        return ", ".join(filter(None, (what, how_far(), f"{time.monotonic() - began:.0f} s")))

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
