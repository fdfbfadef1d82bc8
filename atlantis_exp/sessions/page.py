"""Open and close a page: the folder of a sweep, a search, a decision or a comparison."""

import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from atlantis_exp.config import TrackingConfig
from atlantis_exp.faults import Fault
from atlantis_exp.interrupts import handled
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.journal import Journal, Status
from atlantis_exp.runs.provenance import provenance
from atlantis_exp.tracking.publishing import publishing


def ending(error: BaseException | None) -> tuple[Status, str]:
    """Return the last status of a page whose block raised `error`, and the reason.

    A page stopped by a signal or its time limit is KILLED: the same command continues it.
    """
    if error is None:
        return "FINISHED", ""
    reason = str(error) or type(error).__name__
    if isinstance(error, Fault) and error.exit_code == 124:
        return "KILLED", reason
    return ("FAILED", reason) if isinstance(error, Exception) else ("KILLED", "")


@contextmanager
def opened(
    folder: RunFolder,
    tracking: TrackingConfig,
    outputs: Path,
    labels: Mapping[str, str],
    command: str,
    *,
    prepare: Callable[[], None] = lambda: None,
    others: Sequence[RunFolder] = (),
    ending: Callable[[BaseException | None], tuple[Status, str]] = ending,
) -> Iterator[Journal]:
    """Hold a page's folder and publish its journal, continued from its last commit.

    The page is RUNNING in the block; `ending` gives its status after it.

    labels: tags that the page has from the start.
    command: continues the page.
    prepare: called once the folder is held, before anything is published.
    others: runs of other processes to publish as well.

    Raises: Fault if another process holds the folder, or its journal is damaged.
    """
    with folder.held():
        prepare()
        with publishing(folder, tracking, outputs, labels, others) as journal:
            journal.resume()
            journal.tags(provenance(command))
            journal.status("RUNNING")
            try:
                yield journal
                journal.flush()
            except BaseException as error:
                with suppress(OSError):  # the disk may be full; the next command sees that no process holds the page
                    journal.status(*ending(error))
                raise
            journal.status(*ending(None))


@contextmanager
def terminable() -> Iterator[None]:
    """Turn SIGTERM into an exception; a training in the block installs its own handler."""
    with handled(lambda number, _: sys.exit(128 + number), signal.SIGTERM):
        yield
