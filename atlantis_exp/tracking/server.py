"""Limit the time of calls to an MLflow server."""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mlflow import MlflowClient

_PIECE = 2**16  # bytes of a sent file that give a call a second more


class TooSlow(Exception):
    """A server did not answer in time; not an OSError, which clients retry."""


class PatientClient:
    """An MLflow client whose calls raise TooSlow after some seconds, plus one for each 64 KiB of a sent file."""

    def __init__(self, client: "MlflowClient", seconds: int) -> None:
        self._client, self._seconds = client, seconds

    def __getattr__(self, name: str) -> Callable[..., Any]:
        call = getattr(self._client, name)

        def bounded(*arguments: Any, **options: Any) -> Any:
            sent = os.path.getsize(arguments[1]) if name in ("log_artifact", "log_model_artifact") else 0
            with _patience(self._seconds + sent // _PIECE):
                return call(*arguments, **options)

        return bounded


@contextmanager
def _patience(seconds: int) -> Iterator[None]:
    """Raise TooSlow if the block takes longer, in the main thread, where alone a signal can end a wait."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    late: list[TooSlow] = []

    def give_up(*_: object) -> None:
        late.append(TooSlow(f"the server did not answer in full within {seconds} seconds"))
        raise late[0]

    before = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(seconds)
    try:
        yield
    except Exception:
        if late:  # MLflow has wrapped it
            raise late[0] from None
        raise
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
