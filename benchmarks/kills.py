"""Compare trainings killed again and again with unbroken ones: `python -m benchmarks.kills --kills 1000`.

Each training below first runs unbroken. Then copies get SIGKILLs at random moments shortly after a commit, often during
the next ones, and continue to their end, until all kills have struck. A copy must have the fingerprint of the unbroken
training: weights, replay memory, random streams, emulators, and the contents of its journal.

A session is a new process that knows only the disk. A training's sessions are forks of a server that has imported the
package, since the import takes longer than all else. The last training is a joblib sweep of two seeds, which is started
as by a person, and killed with all its processes.
"""

import itertools
import math
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Protocol

from rich.console import Console

from atlantis_exp import commands, terminal
from atlantis_exp.config import Config
from atlantis_exp.faults import Fault
from atlantis_exp.sessions.contracts import fingerprints
from atlantis_exp.sessions.job import replaced
from atlantis_exp.sessions.page import terminable
from benchmarks.composition import composed
from benchmarks.contest import parser_of, print_results, print_table, run

SMALL = (
    *("experiment=quick", "device=cpu", "threads=1", "budget.forecast=off"),
    *("tracking=none", "tracking.every_steps=100", "tracking.commit_seconds=0.1"),
    *("env.size=40", "env.max_steps=200", "phase.quick.steps=2_000", "replay.capacity=700"),
    *("training.learn_start=200", "training.batch_size=8", "training.precision=fp32"),
    *("evaluation.episodes=2", "evaluation.num_envs=2", "evaluation.every_steps=700", "evaluation.video=false"),
)
TRAININGS = {
    "cnn": ("model=cnn",),
    "resnet": ("model=resnet", "env.size=16", "env.num_envs=8", "env.workers=1"),
    "resnet_fast": ("model=resnet_fast", "env.num_envs=4", "env.workers=2", "objective=quantile", "training.ema=20"),
    "prioritized": ("sampler=prioritized", "env.num_envs=3", "env.workers=1"),
}
SWEEP = "sweep"
_KILLS_OF_ONE = {SWEEP: 5}  # copies of the others are killed until they end
_SECONDS = 0.3  # after a commit; there is one every 0.1 s
_EARLY_SECONDS = 10.0  # of a session's start
_FORKS = multiprocessing.get_context("forkserver")


def main(arguments: Sequence[str] | None = None) -> None:
    """Kill, compare and print."""
    parser = parser_of("kills", __doc__)
    parser.add_argument("--kills", type=int, default=1_000)
    parser.add_argument("--only", choices=[*TRAININGS, SWEEP], action="append", help="sweep is one on joblib")
    parser.add_argument("--early", type=float, default=0.0, help="share of the kills while a session starts")
    options = parser.parse_args(arguments)
    _FORKS.set_forkserver_preload(["atlantis_exp.commands.train", "atlantis_exp.sessions.training"])
    names = options.only or [*TRAININGS, SWEEP]
    console = Console(stderr=True, highlight=False)
    differences: list[str] = []
    struck = dict.fromkeys(names, 0)
    folder = tempfile.mkdtemp(prefix="kills-")
    try:
        console.print(f"some {options.kills * 5 / 60:,.0f} minutes on two cores; first each training unbroken")
        unbroken = {}
        for name in names:
            with terminal.working(f"unbroken: {name}"):
                _, unbroken[name] = _killed(name, Path(folder, name), 0, 0.0)
            console.print(f"unbroken: {name}, {len(unbroken[name])} fingerprints")
        for copy, name in enumerate(itertools.cycle(names)):
            if (left := options.kills - sum(struck.values())) <= 0:
                break
            place = Path(folder, f"{name}-{copy}")
            with terminal.working(f"copy {copy}: {name}", partial(_so_far, place)):
                kills, prints = _killed(name, place, min(left, _KILLS_OF_ONE.get(name, left)), options.early)
            struck[name] += kills
            console.print(f"copy {copy}: {name}, killed {kills} times; {sum(struck.values()):,} of {options.kills:,}")
            parts = sorted({part for part, _ in prints.items() ^ unbroken[name].items()})
            differences += [f"{name}, copy {copy}: {part}" for part in parts]
            if parts:
                console.print(f"DIFFERENT in {', '.join(parts)}: kept in {place}")
            else:
                shutil.rmtree(place)
    finally:
        if not differences:
            shutil.rmtree(folder)
    print_table("kills", ("training", "kills"), [(name, f"{kills:,}") for name, kills in struck.items()])
    print_results({"kills": sum(struck.values()), "differences": differences})
    if differences:
        sys.exit(1)


def _so_far(outputs: Path) -> str:
    return f"{generations(outputs, '*')} commits"


def _killed(name: str, outputs: Path, kills: int, early: float) -> tuple[int, dict[str, str]]:
    """Train one of them to its end, with kills on the way; return how many struck, and its fingerprints."""
    place = f"paths.outputs={outputs}"
    if name == SWEEP:
        launcher = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2")
        words = replaced(SMALL, "seed=0,1", "tracking.commit_seconds=0.5", place)
        command = (sys.executable, "-m", "atlantis_exp", "train", "-m", *launcher, *words)
        struck = run_and_kill(lambda said: start(command, said), outputs, "*", kills, early=early)
        configs = {f"seed {seed}: ": composed(*replaced(SMALL, f"seed={seed}")) for seed in (0, 1)}
    else:
        words = replaced(SMALL, *TRAININGS[name], place)
        configs = {"": composed(*words)}
        struck = run_and_kill(lambda said: _Fork(words, said), outputs, "*", kills, _SECONDS, early)
    prints = {label: fingerprints(config, outputs) for label, config in configs.items()}
    return struck, {f"{label}{part}": value for label, parts in prints.items() for part, value in parts.items()}


def train_and_kill(config: Config, overrides: Sequence[str], outputs: Path, kills: int) -> int:
    """Train under `outputs` and kill it at a random moment after a commit, `kills` times; return how many struck.

    Raises:
        Fault: a session ended with an error.
    """
    # The time of a commit changes nothing, and a run continues from one.
    own = (f"paths.outputs={outputs}", "tracking.commit_seconds=1.0", "resume=auto")
    command = (sys.executable, "-m", "atlantis_exp", "train", *replaced(overrides, *own))
    return run_and_kill(lambda said: start(command, said), outputs, config.run_name(), kills)


class Session(Protocol):
    """A process that trains; `poll` and `wait` work as in Popen."""

    pid: int

    def poll(self) -> int | None: ...

    def wait(self) -> int: ...


def start(command: Sequence[str], said: Path) -> Session:
    """Start a command in its own process group; stderr goes to the file `said`, stdout to one next to it."""
    with open(said, "wb") as errors, open(said.with_name("stdout.txt"), "wb") as lines:
        return subprocess.Popen(command, stdout=lines, stderr=errors, start_new_session=True)


@terminable()
def run_and_kill(
    start: Callable[[Path], Session], outputs: Path, runs: str, kills: int, seconds: float = 1.0, early: float = 0.0
) -> int:
    """Start sessions that write runs under `outputs` until one ends by itself; return how many kills struck.

    Up to `kills` times, send a session's process group a SIGKILL at a random moment within some seconds of a commit.

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
        session = start(outputs / "stderr.txt")
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
                    error = _last_line(outputs / "stderr.txt")
                    raise Fault(f"a session under {outputs} failed: {error or 'it said nothing'}")
                return struck
        finally:  # a signal that ends this process does not reach the session, in its own group
            with suppress(ProcessLookupError):  # it has just ended
                os.killpg(session.pid, signal.SIGKILL)
        struck += session.wait() == -signal.SIGKILL


def _last_line(path: Path) -> str:
    """Return the last line of a file; empty without one."""
    lines = path.read_text(errors="replace").split("\n") if path.exists() else []
    return next((line.strip() for line in reversed(lines) if line.strip()), "")


def generations(outputs: Path, runs: str) -> int:
    """Return the number of commits of some runs so far."""
    newest: dict[Path, int] = {}
    for path in sorted(outputs.glob(f"runs/{runs}/checkpoints/0*/manifest.json")):
        newest[path.parents[2]] = int(path.parent.name)
    return sum(newest.values())


class _Fork(Session):
    """A training in a fork of the server."""

    def __init__(self, words: Sequence[str], said: Path) -> None:
        ready, theirs = _FORKS.Pipe(duplex=False)
        self._process = _FORKS.Process(target=_train, args=(words, said, theirs))
        self._process.start()
        ready.recv()  # it leads its group
        assert self._process.pid is not None
        self.pid = self._process.pid

    def poll(self) -> int | None:
        return self._process.exitcode

    def wait(self) -> int:
        self._process.join()
        assert self._process.exitcode is not None
        return self._process.exitcode


def _train(words: Sequence[str], said: Path, ready: "multiprocessing.connection.Connection[None, None]") -> None:
    """Train as the command line would with these words."""
    os.setsid()
    ready.send(None)
    for number, file in ((1, Path(os.devnull)), (2, said)):
        with open(file, "wb") as opened:
            os.dup2(opened.fileno(), number)
    sys.argv = ["atlantis_exp", "train", *words]
    commands.main()


if __name__ == "__main__":
    run(main)
