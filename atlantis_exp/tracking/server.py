"""Limit the time of calls to an MLflow server."""

import os
from collections.abc import Callable
from concurrent.futures import Future, wait
from threading import Thread
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
            seconds, answer = self._seconds + sent // _PIECE, Future[Any]()

            def ask() -> None:
                try:
                    answer.set_result(call(*arguments, **options))
                except BaseException as error:
                    answer.set_exception(error)

            Thread(target=ask, daemon=True).start()
            if not wait([answer], seconds).done:
                raise TooSlow(f"the server did not answer in full within {seconds} seconds")
            return answer.result()

        return bounded
