"""Run many emulators, here or in worker processes; neither the number of workers nor timing changes a result."""

import atexit
import multiprocessing
import os
import select
import signal
import sys
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from ctypes import Array, c_ubyte
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from types import ModuleType
from typing import Any, NamedTuple, Self, final

import cv2
import numpy as np
import numpy.typing as npt
import psutil

from atlantis_exp.faults import Fault
from atlantis_exp.game.emulator import Emulator
from atlantis_exp.game.preprocessing import Envs, Pixels
from atlantis_exp.games import Game

Rows = npt.NDArray[np.void]  # the last Step of each environment
Calls = dict[int, tuple[Any, ...]]  # environment to the arguments of a call of its emulator

_LAST_SECONDS = 5  # of patience after a request to stop

_FOR_THE_PARENT = (signal.SIGHUP, signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2)


class WorkerDied(Fault):
    """A worker process has died or hangs; the message names it, its environments and the cause."""


class Steps(NamedTuple):
    """A step of several environments, in the order of the call; the arrays are copies."""

    observations: Pixels  # (len(envs), size, size)
    rewards: npt.NDArray[np.float64]
    terminated: npt.NDArray[np.bool_]
    truncated: npt.NDArray[np.bool_]
    life_lost: npt.NDArray[np.bool_]
    frames: npt.NDArray[np.int64]
    points: npt.NDArray[np.float64]  # (len(envs), sources), the rewards in the order of the game's sources


class Emulators(ABC):
    """Emulators of environments 0 to num_envs - 1, all of one game; none begins an episode by itself.

    `envs` are distinct, by default all. Several steps can be under way if their environments differ; a call to an
    environment whose step was not received yet raises RuntimeError. `stop` shortens the wait for a hanging worker.
    """

    def __init__(self, num_envs: int, game: Game, rows: Rows) -> None:
        self.num_envs, self.game = num_envs, game
        self.stop: Callable[[], bool] = lambda: False
        self._rows = rows
        self._sent: deque[Envs] = deque()  # the environments of each step not received yet
        self._unheard = 0  # the latest of these that were not waited for

    def reset(self, envs: Envs, seeds: Sequence[int | None] | None = None) -> Pixels:
        """Begin an episode in each of `envs`; return the first observations, (len(envs), size, size)."""
        seeds = [None] * len(envs) if seeds is None else seeds
        self._call("reset", {int(env): (seed,) for env, seed in zip(envs, seeds, strict=True)})
        return self._columns(envs).observations

    def send(self, actions: Sequence[int] | npt.NDArray[np.int64], envs: Envs | None = None) -> None:
        """Start a step of `envs` with one action each."""
        envs = range(self.num_envs) if envs is None else envs
        calls: Calls = {int(env): (int(action),) for env, action in zip(envs, actions, strict=True)}
        self._refuse_sent(calls)
        self._start("step", calls)
        self._sent.append(envs)
        self._unheard += 1

    def receive(self) -> Steps:
        """Wait for the oldest step sent and return it."""
        if not self._sent:
            raise RuntimeError("no step was sent")
        self._wait(unheard=len(self._sent) - 1)
        return self._columns(self._sent.popleft())

    def step(self, actions: Sequence[int] | npt.NDArray[np.int64], envs: Envs | None = None) -> Steps:
        """Play a step of `envs` with one action each; none may be under way."""
        self._refuse_sent(range(self.num_envs))
        self.send(actions, envs)
        return self.receive()

    def state_dict(self) -> dict[str, Any]:
        states = self._call("state_dict", dict.fromkeys(range(self.num_envs), ()))
        return {str(env): state for env, state in sorted(states.items())}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._call("load_state_dict", {env: (state[str(env)],) for env in range(self.num_envs)})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """End the worker processes; a second call does nothing."""

    @abstractmethod
    def _start(self, method: str, calls: Calls) -> None: ...

    @abstractmethod
    def _results(self) -> dict[int, Any]:
        """Wait for the oldest call and return its results by environment, except those in the rows."""

    def _call(self, method: str, calls: Calls) -> dict[int, Any]:
        self._refuse_sent(calls)
        self._wait(unheard=0)
        self._start(method, calls)
        return self._results()

    def _wait(self, unheard: int) -> None:
        while self._unheard > unheard:
            self._results()
            self._unheard -= 1

    def _refuse_sent(self, called: Container[int]) -> None:
        if any(int(env) in called for envs in self._sent for env in envs):
            raise RuntimeError("a step was sent and not received")

    def _columns(self, envs: Envs) -> Steps:
        return Steps(*(self._rows[name][np.asarray(envs, np.intp)] for name in Steps._fields))


@final
class SerialEmulators(Emulators):
    """Emulators in this process; `send` plays the step."""

    def __init__(self, make: Callable[[], Emulator], num_envs: int) -> None:
        self._emulators = {env: make() for env in range(num_envs)}
        super().__init__(num_envs, self._emulators[0].game, np.empty(num_envs, _row(self._emulators[0])))

    def close(self) -> None:
        pass

    def _start(self, method: str, calls: Calls) -> None:
        self._played = _play(self._emulators, self._rows, method, calls)

    def _results(self) -> dict[int, Any]:
        return self._played


@final
class ProcessEmulators(Emulators):
    """Emulators in worker processes, which play between `send` and `receive`.

    Steps come through anonymous shared memory, all else through pipes. Workers ignore signals and end with this
    process. If one dies or hangs, the wait for it ends the others and raises WorkerDied.
    """

    patience = 60.0  # seconds without an answer or processor time

    def __init__(self, make: Callable[[], Emulator], num_envs: int, workers: int) -> None:
        row = _row(first := make())  # errors of `make` are raised here
        context = multiprocessing.get_context("spawn")  # torch's threads make a fork unsafe
        memory = context.RawArray(c_ubyte, num_envs * row.itemsize)
        super().__init__(num_envs, first.game, np.frombuffer(memoryview(memory), row))
        self._envs = [range(worker, num_envs, workers) for worker in range(workers)]
        self._connections: list[Connection[Any, Any]] = []
        self._processes: list[multiprocessing.context.SpawnProcess] = []
        self._polls: list[select.poll] = []  # connection.poll would take as long as a step
        cores = _cores_for(workers)
        atexit.register(self.close)  # at exit multiprocessing waits for its SIGTERM, which workers ignore
        with _signals_held(), _without_main():
            for worker, envs in enumerate(self._envs):
                connection, theirs = context.Pipe()
                core = cores[worker % len(cores)] if cores else None
                process = context.Process(target=_work, args=(core, theirs, make, envs, memory, row), daemon=True)
                process.start()
                theirs.close()  # the worker holds the only other end: its death ends the pipe
                self._connections.append(connection)
                self._polls.append(select.poll())
                self._polls[-1].register(connection, select.POLLIN)
                self._processes.append(process)

    def close(self) -> None:
        atexit.unregister(self.close)
        for connection, process in zip(self._connections, self._processes, strict=True):
            connection.close()
            process.kill()
            process.join(_LAST_SECONDS)  # the kernel may hold it longer, as for a lost disk

    def _start(self, method: str, calls: Calls) -> None:
        for envs, connection in zip(self._envs, self._connections, strict=True):
            with suppress(ConnectionError):  # the worker has died, which `_results` explains
                connection.send((method, {env: calls[env] for env in envs if env in calls}))

    def _results(self) -> dict[int, Any]:
        results: dict[int, Any] = {}
        for worker, connection in enumerate(self._connections):
            try:
                played, error = ({}, f"hangs: {hung}") if (hung := self._wait_for(worker)) else connection.recv()
            except (EOFError, ConnectionError):
                played, error = {}, f"died of {_cause_of_death(self._processes[worker])}"
            if error is not None:
                self.close()
                raise WorkerDied(f"emulator worker {worker}, environments {list(self._envs[worker])}, {error}")
            results |= played
        return results

    def _wait_for(self, worker: int) -> str:
        """Wait for a worker's answer; return the reason to give up, empty if it has answered or died.

        Polls count the seconds, so the count stops while this process is suspended.
        """
        idle, used = 0, -1.0
        while not self._polls[worker].poll(1_000):  # ms
            try:
                times = psutil.Process(self._processes[worker].pid).cpu_times()
            except psutil.Error:
                return ""  # it has died
            idle, used = (idle + 1, used) if times.user + times.system == used else (0, times.user + times.system)
            if idle >= self.patience or (idle >= _LAST_SECONDS and self.stop()):
                return f"no answer and no work for {idle} s"
        return ""


def make_emulators(make: Callable[[], Emulator], num_envs: int, workers: int) -> Emulators:
    """Return `num_envs` emulators that `make`, a picklable callable, builds in `workers` processes.

    A single environment, or all if there are no workers, stay in this process.
    """
    if num_envs == 1 or workers == 0:
        return SerialEmulators(make, num_envs)
    return ProcessEmulators(make, num_envs, min(workers, num_envs))


@contextmanager
def _signals_held() -> Iterator[None]:
    """Block the parent's signals until its new processes ignore them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _FOR_THE_PARENT)
    try:
        resource_tracker.ensure_running()  # the first process would start it, and it unblocks some signals
        signal.pthread_sigmask(signal.SIG_BLOCK, _FOR_THE_PARENT)
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _without_main() -> Iterator[None]:
    """Hide the main module, which a new process would run again: a script that trains would train there, too."""
    main, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _row(emulator: Emulator) -> np.dtype[np.void]:
    pixels, points = (emulator.preprocessing.size,) * 2, (len(emulator.game.sources),)
    formats = [(np.uint8, pixels), np.float64, np.bool_, np.bool_, np.bool_, np.int64, (np.float64, points)]
    return np.dtype({"names": Steps._fields, "formats": formats}, align=True)


def _play(emulators: dict[int, Emulator], rows: Rows, method: str, calls: Calls) -> dict[int, Any]:
    """Call a method of emulators; write steps and first observations to the rows, return other results."""
    returned = {}
    for env, arguments in calls.items():
        result = getattr(emulators[env], method)(*arguments)
        if method == "step":
            rows[env] = result
        elif method == "reset":
            rows["observations"][env] = result
        else:
            returned[env] = result
    return returned


def _cores_for(workers: int) -> list[int]:
    """Return a core for each worker, since workers that wake together would all start on one.

    With fewer workers than cores return an empty list (any core): parallel runs would share the same few.
    """
    if not hasattr(os, "sched_getaffinity"):  # no Linux
        return []
    cores = sorted(os.sched_getaffinity(0))
    return cores if workers >= len(cores) else []


def _work(
    core: int | None,
    connection: "Connection[Any, Any]",
    make: Callable[[], Emulator],
    envs: Iterable[int],
    memory: "Array[c_ubyte]",
    row: np.dtype[np.void],
) -> None:
    """Answer the parent's calls until it closes the pipe or dies; the last answer may be an error."""
    for number in _FOR_THE_PARENT:
        signal.signal(number, signal.SIG_IGN)
    cv2.setNumThreads(1)
    if core is not None:
        os.sched_setaffinity(0, {core})
    try:
        emulators = {env: make() for env in envs}
        rows = np.frombuffer(memoryview(memory), row)
        while True:
            method, calls = connection.recv()
            connection.send((_play(emulators, rows, method, calls), None))
    except (EOFError, ConnectionError):
        pass
    except Exception as error:
        connection.send(({}, f"died of {error!r}"))


def _cause_of_death(process: "multiprocessing.context.SpawnProcess") -> str:
    process.join()
    assert process.exitcode is not None
    return signal.Signals(-process.exitcode).name if process.exitcode < 0 else f"exit code {process.exitcode}"
