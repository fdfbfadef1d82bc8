"""Note Ctrl-C from the start, even if a library swallows the KeyboardInterrupt."""

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
    return _seen


def _note(_: int, __: FrameType | None) -> NoReturn:
    global _seen
    _seen = True
    raise KeyboardInterrupt
