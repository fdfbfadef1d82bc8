"""Ctrl-C from the first moment on, noted even where a library swallows the KeyboardInterrupt."""

import signal
from types import FrameType
from typing import NoReturn

_seen = False


def listen() -> None:
    """Note a SIGINT and raise KeyboardInterrupt, unless the process was started to ignore it."""
    global _seen
    _seen = False
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, _note)


def seen() -> bool:
    """Return whether a SIGINT has come, be it that its KeyboardInterrupt was swallowed."""
    return _seen


def _note(_: int, __: FrameType | None) -> NoReturn:
    global _seen
    _seen = True
    raise KeyboardInterrupt
