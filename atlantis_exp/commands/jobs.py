"""A job of a sweep, in whatever process its launcher has put it."""

import os
import signal
import subprocess
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, redirect_stderr, redirect_stdout, suppress

from atlantis_exp.commands.app import JOB_OF, job_of
from atlantis_exp.commands.train import final_result, train, watch_of
from atlantis_exp.config import Config, ConfigError
from atlantis_exp.faults import Fault

_OUTPUT = "output.txt"  # what a run in a process of its own printed


def train_job(config: Config) -> None:
    """Train here, or, as a job of joblib's, in a process of its own: whatever ends it, the other jobs go on.

    Raises:
        Fault: where the run fails; as the one line that a launcher can carry from machine to machine.
    """
    if job_of() is None:
        train(config)
    elif job_of() == "joblib":
        _train_apart(config)
    else:
        try:
            with _kept_output(config) if job_of() == "ray" else nullcontext():
                train(config)
        except (ConfigError, Fault, OSError):
            raise
        except Exception as error:
            traceback.print_exc()
            raise Fault(f"run {config.run_name()}: {type(error).__name__}: {error}") from error


@contextmanager
def _kept_output(config: Config) -> Iterator[None]:
    """What is printed goes to the run's folder, since Ray's own files of it are on whatever machine this is."""
    from atlantis_exp.commands.runs import RunFolder

    folder = RunFolder.of(config).path
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / _OUTPUT, "a", buffering=1) as output, redirect_stdout(output), redirect_stderr(output):
        yield


def _train_apart(config: Config) -> None:
    from atlantis_exp.commands.runs import RunFolder
    from atlantis_exp.tracking.journal import Journal, JournalError

    folder = RunFolder.of(config)
    if config.resume != "never" and final_result(config, folder) is not None:
        return
    if not watch_of(folder)():
        raise Fault(f"run {folder.name}: the sweep has ended", exit_code=128 + signal.SIGTERM)
    folder.path.mkdir(parents=True, exist_ok=True)
    with open(folder.path / _OUTPUT, "a+") as output:
        start = output.tell()
        code = subprocess.run(
            [sys.executable, "-m", "atlantis_exp", "train", *sys.argv[1:]],
            env={**os.environ, JOB_OF: "apart"},
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            check=False,
        ).returncode
        if folder.parent and not RunFolder(folder.parent).is_held:
            os._exit(code)  # the process that this worker works for was killed: there is nobody to tell
        output.seek(start)
        said = output.read().splitlines()
    if code == 0:
        return
    reason = (
        f"killed by {signal.Signals(-code).name}"
        if code < 0
        else (said or ["it said nothing"])[-1].removeprefix("atlantis_exp: ")
    )
    if code < 0 or (code == 1 and folder.state != "failed"):  # it could not say so itself
        with suppress(Fault, JournalError), folder.held():
            Journal(folder.path).status("KILLED" if code < 0 else "FAILED", reason)
    raise Fault(f"run {folder.name}: {reason}; see {folder.path / _OUTPUT}", exit_code=code if code > 0 else 128 - code)
