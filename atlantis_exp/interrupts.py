"""Handle Ctrl-C from the first moment, even if a library swallows KeyboardInterrupt or aborts on it."""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

_seen = False


def listen() -> None:
    """Exit on SIGINT while there is nothing to lose, unless the process was started to ignore it."""
    global _seen
    _seen = False
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, _leave)


def hold() -> None:
    """Record SIGINT and raise KeyboardInterrupt from now on, since work begins."""
    if signal.getsignal(signal.SIGINT) is _leave:
        signal.signal(signal.SIGINT, _note)
        sys.unraisablehook = _quiet


def seen() -> bool:
    """Return whether a SIGINT has come since `hold`, even if its KeyboardInterrupt was swallowed."""
    return _seen


@contextmanager
def handled(handler: Callable[[int, FrameType | None], None], *numbers: int) -> Iterator[dict[int, Any]]:
    """Handle signals in the main thread while the block runs; yield the earlier handlers. Other threads get none."""
    is_main = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, handler) for number in numbers if is_main}
    try:
        yield before
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


def _leave(_: int, __: FrameType | None) -> NoReturn:
    # An exception would run through imports: pydantic swallows it, torch aborts the process.
    show_cursor = "\x1b[?25h" if sys.stdout.isatty() else ""
    os.write(2, f"{show_cursor}atlantis_exp: interrupted\n".encode())
    os._exit(128 + signal.SIGINT)


def _note(_: int, __: FrameType | None) -> NoReturn:
    global _seen
    _seen = True
    raise KeyboardInterrupt


def _quiet(unraisable: "sys.UnraisableHookArgs") -> None:
    """Print an exception that Python cannot raise, unless it is the KeyboardInterrupt that `_note` recorded."""
    if unraisable.exc_type is not KeyboardInterrupt:
        sys.__unraisablehook__(unraisable)
