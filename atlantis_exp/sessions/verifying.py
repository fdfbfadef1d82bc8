"""Verify that a training that is killed and continued equals the unbroken one."""

import json
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Protocol

from atlantis_exp import terminal
from atlantis_exp.build import build_memory
from atlantis_exp.checking import flatten, to_dict
from atlantis_exp.config import Config
from atlantis_exp.faults import Fault
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.provenance import provenance
from atlantis_exp.sessions.job import Job, command_line, labels, replaced
from atlantis_exp.sessions.page import terminable
from atlantis_exp.tracking.publishing import publishing
from atlantis_exp.training.checkpoint import Checkpoints
from atlantis_exp.training.fingerprint import fingerprint

_KILLS = 3
_EARLY_SECONDS = 10.0  # in which a session starts
_ERRORS, _OUTPUT = "stderr.txt", "stdout.txt"  # of the latest session


def verify_resume(job: Job) -> None:
    """Train once unbroken and once with SIGKILLs at random moments, compare, and record the verdict as a run."""
    config, outputs = job.config, job.outputs
    folder = RunFolder(outputs / "verifications" / config.run_name())
    overrides = replaced(job.overrides, "tracking=none")
    with folder.held():
        for name in ("unbroken", "killed"):
            shutil.rmtree(folder.path / name, ignore_errors=True)
        print(f"training {config.run_name()} unbroken", flush=True)
        with terminal.working("  unbroken", partial(_last_line, folder.path / "unbroken" / _OUTPUT)):
            train_and_kill(config, overrides, folder.path / "unbroken", 0)
        print(f"training it again, killed {_KILLS} times", flush=True)
        with terminal.working("  killed and continued", partial(_last_line, folder.path / "killed" / _OUTPUT)):
            kills = train_and_kill(config, overrides, folder.path / "killed", _KILLS)
        with terminal.working("comparing the two"):
            unbroken, killed = (fingerprints(config, folder.path / name) for name in ("unbroken", "killed"))
        differing = sorted(part for part in unbroken if unbroken[part] != killed[part])
        verdict = f"differs in {', '.join(differing)}" if differing else "is the unbroken one, bit for bit"
        shown = labels(f"verify-resume {job.title}", job.colour, "verification")
        with publishing(folder, config.tracking, outputs, shown) as journal:
            journal.params({key: str(value) for key, value in flatten(to_dict(config)).items()})
            journal.tags({**provenance(command_line("verify-resume", *job.overrides)), "verdict": verdict})
            journal.note(f"A training that was killed {kills} times {verdict}.")
            journal.metrics({"verification/equal": not differing, "verification/kills": kills}, 0)
            hashes = json.dumps({"unbroken": unbroken, "killed": killed}, indent=2)
            journal.artifact("fingerprints.json", hashes.encode())
            journal.flush()
            journal.status("FAILED" if differing else "FINISHED")
    for part, value in unbroken.items():
        print(f"{part:16}{value[:16]}  {killed[part][:16]}{'  DIFFERENT' if part in differing else ''}")
    print(f"\nthe training killed {kills} times {verdict}")
    if differing:
        raise Fault(f"resuming is not exact: see {folder.path}")


def train_and_kill(config: Config, overrides: Sequence[str], outputs: Path, kills: int) -> int:
    """Train under `outputs` and kill it at a random moment after a commit, `kills` times; return how many struck.

    Raises:
        Fault: a session ended with an error.
    """
    # The moments of commits change nothing, and a run continues from one.
    own = (f"paths.outputs={outputs}", "tracking.commit_seconds=1.0", "resume=auto")
    command = (sys.executable, "-m", "atlantis_exp", "train", *replaced(overrides, *own))
    return run_and_kill(lambda said: start(command, said), outputs, config.run_name(), kills)


class Session(Protocol):
    """A process that trains; `poll` and `wait` as of Popen."""

    pid: int

    def poll(self) -> int | None: ...

    def wait(self) -> int: ...


def start(command: Sequence[str], said: Path) -> Session:
    """Start a command in a process group of its own; stderr goes to the file `said`, stdout to one next to it."""
    with open(said, "wb") as errors, open(said.with_name(_OUTPUT), "wb") as lines:
        return subprocess.Popen(command, stdout=lines, stderr=errors, start_new_session=True)


@terminable()
def run_and_kill(
    start: Callable[[Path], Session], outputs: Path, runs: str, kills: int, seconds: float = 1.0, early: float = 0.0
) -> int:
    """Start sessions that write runs under `outputs` until one ends by itself; return how many kills struck.

    Up to `kills` times, a session's process group gets a SIGKILL at a random moment within some seconds of a commit.

    Args:
        start: starts a session, the leader of a process group, whose stderr goes to the given file.
        runs: the pattern of the runs' names.
        early: the share of kills in a session's first `_EARLY_SECONDS` instead.

    Raises:
        Fault: a session ended with an error.
    """
    struck = 0
    outputs.mkdir(parents=True, exist_ok=True)
    while True:
        before = generations(outputs, runs)
        session = start(outputs / _ERRORS)
        moment = time.monotonic() + random.random() * _EARLY_SECONDS if random.random() < early else math.inf
        try:
            while struck < kills and session.poll() is None:
                time.sleep(0.01)
                if time.monotonic() > moment:
                    break
                if generations(outputs, runs) > before:
                    time.sleep(random.random() * seconds)
                    break
            else:
                if session.wait():
                    error = _last_line(outputs / _ERRORS)
                    raise Fault(f"a session under {outputs} failed: {error or 'it said nothing'}")
                return struck
        finally:  # a signal that ends this process does not reach the session, in a group of its own
            with suppress(ProcessLookupError):  # it has just ended
                os.killpg(session.pid, signal.SIGKILL)
        struck += session.wait() == -signal.SIGKILL


def fingerprints(config: Config, outputs: Path) -> dict[str, str]:
    """Return the hashes of a training that has ended under `outputs`. Raises: Fault."""
    memory = build_memory(config)
    folder = RunFolder(outputs / "runs" / config.run_name())
    state = Checkpoints(folder.checkpoints, config.identity()).load(memory)
    if state is None:
        raise Fault(f"{folder.path} has no checkpoint")
    return fingerprint(state, memory, folder.path)


def _last_line(path: Path) -> str:
    """Return the last line of a file, empty if there is none."""
    lines = path.read_text(errors="replace").split("\n") if path.exists() else []
    return next((line.strip() for line in reversed(lines) if line.strip()), "")


def generations(outputs: Path, runs: str) -> int:
    """Return the number of commits of some runs so far."""
    newest: dict[Path, int] = {}
    for path in sorted(outputs.glob(f"runs/{runs}/checkpoints/0*/manifest.json")):
        newest[path.parents[2]] = int(path.parent.name)
    return sum(newest.values())
