"""Run a sweep as the parent run of its trainings, with their table on its page."""

import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, nullcontext, suppress
from functools import partial
from math import ceil
from pathlib import Path
from typing import Any, get_args

from atlantis_exp import terminal
from atlantis_exp.checking import digest
from atlantis_exp.comparison.tables import to_csv
from atlantis_exp.faults import Fault
from atlantis_exp.runs.folder import TABLE_COLUMNS, TRACEBACK, RunFolder, State, has_ended
from atlantis_exp.runs.journal import NOTE_LENGTH, Journal, Status, adopt
from atlantis_exp.sessions.job import Job, fitted
from atlantis_exp.sessions.launchers import BASIC, Launcher, in_turn
from atlantis_exp.sessions.launchers.joblib import train_side_by_side
from atlantis_exp.sessions.live import LiveTable
from atlantis_exp.sessions.page import ending, opened, terminable
from atlantis_exp.sessions.training import measure, train
from atlantis_exp.tracking.publishing import catch_up
from atlantis_exp.training.forecast import duration

_PAGE_SECONDS = 60.0  # between two looks at the runs

Runs = Mapping[RunFolder, Job]
"""The folders of a sweep's runs, each with its training."""


def sweep(
    jobs: Sequence[Job],
    launcher: Launcher,
    swept: Sequence[str],
    command: str,
    on_a_node: Callable[[Sequence[str]], None],
    train: Callable[[Job], object] = train,
) -> None:
    """Train jobs with a launcher; print the table of their runs before and after.

    Args:
        swept: the overrides with several values, as typed.
        command: repeats the sweep.
        on_a_node: trains the job of some overrides in a process that Slurm has started.
        train: trains a job in this process.

    Raises: Fault if another process runs the same sweep, or a training failed, once all have ended.
    """
    with ledger(jobs, swept, launcher, command):
        match launcher.name:
            case "joblib":
                train_side_by_side(jobs, launcher)
            case "slurm":
                from atlantis_exp.sessions.launchers.slurm import submit

                submit(jobs, launcher, on_a_node)
            case _:
                in_turn(train, jobs)


@contextmanager
def ledger(
    jobs: Sequence[Job], swept: Sequence[str] = (), launcher: Launcher = BASIC, command: str = ""
) -> Iterator[None]:
    """Print a sweep's table of runs before and after the block, and keep its page.

    There is no page if this process trains them and tracking is none. Jobs in other processes only write their folders:
    this process shows their progress and publishes them. Each run's folder names its parent before the first run
    starts; the same set of runs has the same parent. Arguments and faults as for `sweep`.
    """
    runs = {RunFolder.of(job.config): job for job in jobs}
    is_shown = not launcher.is_basic or jobs[0].config.tracking.name != "none"
    _print_table(runs)
    try:
        with _page(runs, swept, launcher, command) if is_shown else nullcontext():
            yield
    finally:
        _print_table(runs)


def say_hours(jobs: Sequence[Job], launcher: Launcher) -> None:
    """Print how many of a sweep's jobs train at a time, and the hours for all if each takes as long as the first."""
    left = [job for job in jobs if not has_ended(job.config)]
    if not left:
        return
    at_once = min(launcher.settings.get("n_jobs", 1), len(left))
    hours = ""
    if left[0].config.budget.forecast != "off":
        each = measure(left[0], launcher.settings.get("cores"))[1].hours
        hours = f": about {duration(each * ceil(len(left) / at_once))} if all take as long as {left[0].title}"
    print(f"{how_many(launcher)}{hours}", flush=True)


def how_many(launcher: Launcher) -> str:
    """Return how many trainings run at a time, in words."""
    if launcher.is_basic:
        return "one training after the other"
    cores = launcher.settings["cores"]
    return f"{launcher.settings['n_jobs']} trainings at a time, {cores} {'core' if cores == 1 else 'cores'} each"


def _print_table(runs: Runs) -> None:
    states = {folder: folder.state for folder in runs}
    for folder, state in states.items():
        print(f"  {state:12}{folder.name}{_reason(folder, state)}")
    counted = Counter(states.values())
    counts = ", ".join(f"{counted[state]} {state}" for state in get_args(State) if state in counted)
    print(f"sweep of {len(runs)} runs: {counts}", flush=True)


def _reason(folder: RunFolder, state: State) -> str:
    """Return why a run failed or was killed, and the file with its traceback."""
    if not folder.error:
        return ""
    path = folder.path / TRACEBACK
    return f": {terminal.harmless(folder.error)}" + (f" ({path})" if state == "failed" and path.exists() else "")


@contextmanager
def _page(runs: Runs, swept: Sequence[str], launcher: Launcher, command: str) -> Iterator[None]:
    config = next(iter(runs.values())).config
    outputs = Path(config.paths.outputs)
    sweep = RunFolder(outputs / "sweeps" / f"sweep-{digest({'runs': sorted(folder.name for folder in runs)})}")
    labels = {"mlflow.runName": f"sweep {' '.join(swept)}", "atlantis.kind": "training sweep"}

    def adopt_all() -> None:
        for folder, job in runs.items():
            with suppress(Fault):  # a run in another process keeps its parent
                if job.config.resume == "never" and not launcher.is_basic and folder.has_started:
                    print(f"the earlier run is kept as {folder.put_aside()}")
                with folder.held():
                    adopt(folder.path, sweep.path)

    if not launcher.is_basic:
        catch_up(outputs, config.tracking.uri)  # the jobs do not do so
    others = () if launcher.is_basic else tuple(runs)
    with (
        terminable(),
        opened(
            *(sweep, config.tracking, outputs, labels, command),
            prepare=adopt_all,
            others=others,
            ending=partial(_ending, runs),
        ) as journal,
    ):
        describe = partial(_describe, journal, runs)
        describe()
        try:
            with ExitStack() as looks:
                looks.enter_context(_every(_PAGE_SECONDS, describe))
                if not launcher.is_basic:
                    table = looks.enter_context(closing(LiveTable([*runs.values()], [*runs])))
                    looks.enter_context(_every(table.seconds, table.look))
                yield
        finally:
            _tabulate(journal, runs)
            describe()


@contextmanager
def _every(seconds: float, look: Callable[[], None]) -> Iterator[None]:
    """Call `look` every `seconds` in a thread until the block ends."""
    closing = threading.Event()

    def run() -> None:
        while not closing.wait(seconds):
            with suppress(OSError, ValueError, Fault):  # the next look may succeed
                look()

    thread = threading.Thread(target=run, name=f"every {seconds:g} s", daemon=True)
    thread.start()
    try:
        yield
    finally:
        closing.set()
        thread.join()


def _ending(runs: Runs, error: BaseException | None) -> tuple[Status, str]:
    failures = [f"{folder.name}: {folder.error}" for folder in runs if folder.state == "failed"]
    if failures:
        return "FAILED", "\n".join([f"{len(failures)} of {len(runs)} runs failed", *failures])
    if error is None and any(folder.state != "done" for folder in runs):
        return "KILLED", ""
    return ending(error)


def _describe(journal: Journal, runs: Runs) -> None:
    """Write the sweep's table to its page."""
    head = ("run", "state", "steps", "mean", "+-", "median", "IQM", "high", "low", "hours")
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * 2}{' ---: |' * 8}"]
    failures = []
    for folder, job in runs.items():
        row = [job.title, folder.state, *[""] * 8]
        if (result := folder.result) is not None:
            row[2] = f"{result.steps:,}"
            if result.evaluation:
                row[3:9] = [f"{result.evaluation[f'evaluation/{point}']:,.0f}" for point in TABLE_COLUMNS]
            if "hours" in result.counts:
                row[9] = f"{result.counts['hours']:.2f}"
        lines.append(f"| {' | '.join(row)} |")
        if folder.state == "failed":
            told = f" (details in `{TRACEBACK}` of the run)" if (folder.path / TRACEBACK).exists() else ""
            failures.append(f"- **{job.title} failed**: {folder.error}{told}")
    above = fitted(failures, NOTE_LENGTH // 4, "`runs.csv`") + "\n\n"
    journal.note(f"{above}{fitted(lines, NOTE_LENGTH - len(above), '`runs.csv`')}".strip())
    journal.flush()


def _tabulate(journal: Journal, runs: Runs) -> None:
    """Write all numbers of the sweep's runs to `runs.csv`."""
    rows: list[dict[str, Any]] = []
    for folder, job in runs.items():
        result = folder.result
        numbers = {"steps": result.steps, **result.counts, **result.evaluation} if result else {}
        rows.append({"run": folder.name, "title": job.title, "state": folder.state, **numbers})
    journal.artifact("runs.csv", to_csv(rows).encode())
