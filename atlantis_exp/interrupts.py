"""Ctrl-C from the first moment on, also where a library swallows a KeyboardInterrupt or aborts at it."""

import os
import signal
import sys
from types import FrameType
from typing import NoReturn

_seen = False


def listen() -> None:
    """End the process at a SIGINT, as long as there is nothing to lose; one that was started to ignore it does."""
    global _seen
    _seen = False
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, _leave)


def hold() -> None:
    """Note a SIGINT and raise KeyboardInterrupt from now on: work begins."""
    if signal.getsignal(signal.SIGINT) is _leave:
        signal.signal(signal.SIGINT, _note)
        sys.unraisablehook = _quiet


def seen() -> bool:
    """Return whether a SIGINT has come since `hold`, even if its KeyboardInterrupt was swallowed."""
    return _seen


def _leave(_: int, __: FrameType | None) -> NoReturn:
    # Raising here would run through imports: pydantic swallows it, torch's abort the process.
    show_cursor = "\x1b[?25h" if sys.stdout.isatty() else ""
    os.write(2, f"{show_cursor}atlantis_exp: interrupted\n".encode())
    os._exit(128 + signal.SIGINT)


def _note(_: int, __: FrameType | None) -> NoReturn:
    global _seen
    _seen = True
    raise KeyboardInterrupt


def _quiet(unraisable: "sys.UnraisableHookArgs") -> None:
    """Print what Python cannot raise, except a KeyboardInterrupt: it is noted."""
    if unraisable.exc_type is not KeyboardInterrupt:
        sys.__unraisablehook__(unraisable)
