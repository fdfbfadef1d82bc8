"""Let contestants work in turns, and print tables."""

import argparse
import json
import multiprocessing
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from importlib.util import find_spec
from multiprocessing.connection import Connection
from typing import Any, Generic, Self, TypeVar

from rich.console import Console
from rich.table import Table

from atlantis_exp import terminal
from atlantis_exp.faults import Fault

T = TypeVar("T")
Measure = Callable[[float], T]  # of seconds to work for


class Contestant(Generic[T]):
    """A program in its own process that works only while it is measured.

    There `program`, a picklable callable, builds it, warms it up and yields the function that measures it.
    """

    def __init__(self, program: Callable[[], AbstractContextManager[Measure[T]]]) -> None:
        context = multiprocessing.get_context("spawn")  # a clean process, without this one's memory and threads
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(program, theirs))
        self._process.start()
        theirs.close()
        with terminal.working("warming a contestant up"):
            self._connection.recv()

    def begin(self, seconds: float) -> None:
        """Start the work; `finish` returns the result."""
        self._connection.send(seconds)

    def finish(self) -> T:
        """Wait for the measurement and return it. Raises: EOFError if the process died; stderr has its traceback."""
        measured: T = self._connection.recv()
        return measured

    def measure(self, seconds: float) -> T:
        """Return the measurement over some seconds."""
        self.begin(seconds)
        return self.finish()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()
        self._process.join()


def _serve(program: Callable[[], AbstractContextManager[Measure[Any]]], connection: "Connection[Any, Any]") -> None:
    with program() as measure:
        connection.send("warm")
        try:
            while True:
                connection.send(measure(connection.recv()))
        except EOFError:
            pass


class _Help(argparse.ArgumentDefaultsHelpFormatter, argparse.RawDescriptionHelpFormatter): ...


def parser_of(
    name: str, doc: str | None, rounds: int | None = None, seconds: float | None = None
) -> argparse.ArgumentParser:
    """Return a benchmark's parser, with these defaults of --rounds and --seconds if it takes turns."""
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks.{name}", description=doc, formatter_class=_Help)
    if rounds is not None:
        parser.add_argument("--rounds", type=int, default=rounds, help="turns of each")
    if seconds is not None:
        parser.add_argument("--seconds", type=float, default=seconds, help="length of a turn")
    return parser


def run(main: Callable[[], None]) -> None:
    """Run a benchmark; a fault, such as a wrong override, ends it with one line."""
    try:
        main()
    except Fault as error:
        terminal.warn(str(error))
        sys.exit(error.exit_code)


def together(contestants: Sequence[Contestant[float]], seconds: float) -> float:
    """Let contestants work at the same time; return the sum of their rates."""
    for contestant in contestants:
        contestant.begin(seconds)
    return sum([contestant.finish() for contestant in contestants])


def take_turns(turns: Mapping[str, Callable[[], T]], rounds: int) -> dict[str, list[T]]:
    """Call all in turn, A B C A B C ..., so that other load affects all alike; return the results of each."""
    results: dict[str, list[T]] = {name: [] for name in turns}
    total, began = rounds * len(turns), time.monotonic()

    def how_far() -> str:
        done = sum(map(len, results.values()))
        left = (time.monotonic() - began) / done * (total - done) if done else None
        return f"turn {min(done + 1, total)} of {total}" + ("" if left is None else f", {terminal.clock(left)} left")

    with terminal.working("measuring", how_far):
        for _ in range(rounds):
            for name, turn in turns.items():
                results[name].append(turn())
    return results


def calls_per_second(call: Callable[[], object], seconds: float) -> float:
    """Return the rate of successive calls."""
    began, calls, elapsed = time.perf_counter(), 0, 0.0
    while elapsed < seconds:
        call()
        calls += 1
        elapsed = time.perf_counter() - began
    return calls / elapsed


def ratio(rates: Sequence[float] | None, others: Sequence[float] | None) -> float | None:
    """Return the ratio of the medians, or None if one side was not measured."""
    return statistics.median(rates) / statistics.median(others) if rates and others else None


def paired_ratio(rates: Sequence[float] | None, others: Sequence[float] | None) -> float | None:
    """Return the median of the rounds' ratios, or None if one side was not measured."""
    return statistics.median(a / b for a, b in zip(rates, others, strict=True)) if rates and others else None


def medians(rates: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """Return the median rate of each contestant."""
    return {name: statistics.median(values) for name, values in rates.items()}


def missing(peer: str) -> bool:
    """Return whether a peer's package is missing, and say so."""
    if find_spec(peer) is not None:
        return False
    print(f"leaving out {peer}, which is not installed: pip install 'atlantis-exp[peers]'")
    return True


def print_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table whose first column names the row."""
    table = Table(title=title, title_justify="left")
    for index, column in enumerate(columns):
        table.add_column(column, justify="right" if index else "left", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    Console(width=120, soft_wrap=True).print(table)


def print_rates(title: str, unit: str, rates: Mapping[str, Sequence[float]]) -> None:
    """Print a table of rates, a row for each contestant."""
    print_table(
        title,
        ("", f"median {unit}", "least", "most"),
        [(name, *(f"{f(values):,.0f}" for f in (statistics.median, min, max))) for name, values in rates.items()],
    )


def print_results(results: Mapping[str, Any]) -> None:
    """Print the figures as a line of JSON."""
    print(json.dumps(results), flush=True)
