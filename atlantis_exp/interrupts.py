"""Ctrl-C from the first moment on, noted even where a library swallows the KeyboardInterrupt."""

import signal
import sys
from types import FrameType
from typing import NoReturn

_seen = False


def listen() -> None:
    """Note a SIGINT and raise KeyboardInterrupt, unless the process was started to ignore it."""
    global _seen
    _seen = False
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, _note)
        sys.unraisablehook = _quiet


def seen() -> bool:
    """Return whether a SIGINT has come, even if its KeyboardInterrupt was swallowed."""
    return _seen


def _quiet(unraisable: "sys.UnraisableHookArgs") -> None:
    """Print what Python cannot raise, except a KeyboardInterrupt: it is noted."""
    if unraisable.exc_type is not KeyboardInterrupt:
        sys.__unraisablehook__(unraisable)


def _note(_: int, __: FrameType | None) -> NoReturn:
    global _seen
    _seen = True
    raise KeyboardInterrupt
