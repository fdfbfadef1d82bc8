"""A sweep as a run of its own: what its runs are shown under, with their table and figures on its page."""

import csv
import io
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, NoReturn, get_args

import numpy as np

from atlantis_exp import terminal
from atlantis_exp.checking import digest
from atlantis_exp.faults import Fault
from atlantis_exp.media import curves, strips
from atlantis_exp.registry import TABLE_COLUMNS
from atlantis_exp.runs.folder import TRACEBACK, RunFolder, State
from atlantis_exp.runs.journal import NOTE_LENGTH, Journal, Status, adopt, curve, fitted
from atlantis_exp.runs.provenance import provenance
from atlantis_exp.sessions.job import Job
from atlantis_exp.sessions.launchers import BASIC, Launcher
from atlantis_exp.sessions.live import LiveTable
from atlantis_exp.tracking.publishing import catch_up, publishing

_PAGE_SECONDS = 60.0  # between two looks at the runs while they are trained


@contextmanager
def ledger(
    jobs: Sequence[Job], swept: Sequence[str] = (), launcher: Launcher = BASIC, command: str = ""
) -> Iterator[None]:
    """Print a sweep's table of runs before and after it, and keep a page of it in MLflow (tracking=mlflow).

    Where a launcher runs the jobs in other processes, these write their folders only: this one shows their progress,
    publishes them, and, but for Slurm's, has them commit before it ends itself.

    Whatever process trains them, the runs know their parent from their folders, where it is noted before the first
    starts. The same set of runs is the same parent again. However the block ends, the page is closed with it.

    swept: the overrides that name several values, as typed.
    command: what repeats the sweep.

    Raises:
        Fault: while another process runs the same sweep.
    """
    jobs = list({job.config.run_name(): job for job in jobs}.values())
    folders = [RunFolder.of(job.config) for job in jobs]
    _print_table(folders)
    try:
        if launcher.is_basic and jobs[0].config.tracking.name == "none":
            yield
        else:
            with _page(jobs, folders, swept, launcher, command):
                yield
    finally:
        _print_table(folders)


def _print_table(folders: Sequence[RunFolder]) -> None:
    states = [folder.state for folder in folders]
    for folder, state in zip(folders, states, strict=True):
        print(f"  {state:12}{folder.name}{_reason(folder)}")
    counts = ", ".join(f"{states.count(state)} {state}" for state in get_args(State) if state in states)
    print(f"sweep of {len(folders)} runs: {counts}", flush=True)


def _reason(folder: RunFolder) -> str:
    """Why a run failed or was killed, and the file that tells more."""
    if not folder.error:
        return ""
    path = folder.path / TRACEBACK
    return f": {terminal.harmless(folder.error)}" + (f" ({path})" if folder.state == "failed" and path.exists() else "")


@contextmanager
def _page(
    jobs: Sequence[Job], folders: Sequence[RunFolder], swept: Sequence[str], launcher: Launcher, command: str
) -> Iterator[None]:
    outputs = jobs[0].outputs
    identity = digest({"runs": sorted(folder.name for folder in folders)})
    sweep = RunFolder(outputs / "sweeps" / f"sweep-{identity}")
    name = f"sweep {' '.join(swept)}"
    shown = {"mlflow.runName": name, "atlantis.kind": "training sweep"}
    if not launcher.is_basic:
        catch_up(outputs, jobs[0].config.tracking.uri)  # the jobs do not
    others = () if launcher.is_basic else folders
    with sweep.held(), terminable():
        for job, folder in zip(jobs, folders, strict=True):
            with suppress(Fault):  # what runs elsewhere stays where it is
                if job.config.resume == "never" and not launcher.is_basic and folder.has_started:
                    print(f"the run that was here is kept as {folder.put_aside()}")
                with folder.held():
                    adopt(folder.path, sweep.path)
        with publishing(sweep, jobs[0].config.tracking, outputs, shown, others) as journal:
            was_finished = sweep.status == "FINISHED"
            journal.resume()
            journal.tags(provenance(command))
            _describe(journal, jobs, folders)
            journal.status("RUNNING")
            error: BaseException | None = None
            try:
                with (
                    _every(_PAGE_SECONDS, lambda: _describe(journal, jobs, folders)),
                    _launched(launcher, jobs, folders),
                ):
                    yield
            except BaseException as raised:
                error = raised
                raise
            finally:
                status, reason = _ending(folders, error)
                try:
                    _draw(journal, jobs, folders, was_finished)
                    _describe(journal, jobs, folders)
                finally:
                    journal.status(status, reason)


@contextmanager
def _launched(launcher: Launcher, jobs: Sequence[Job], folders: Sequence[RunFolder]) -> Iterator[None]:
    """Show the jobs of a launcher while it runs them."""
    if launcher.is_basic:
        yield
        return
    table = LiveTable(jobs, folders)
    try:
        with _every(table.seconds, table.look):
            yield
    finally:
        table.close()


@contextmanager
def _every(seconds: float, look: Callable[[], None]) -> Iterator[None]:
    """Call `look` now and then in a thread until the block ends."""
    closing = threading.Event()

    def run() -> None:
        while not closing.wait(seconds):
            with suppress(OSError, ValueError, Fault):  # the next look may fare better
                look()

    thread = threading.Thread(target=run, name=f"every {seconds:g} s", daemon=True)
    thread.start()
    try:
        yield
    finally:
        closing.set()
        thread.join()


@contextmanager
def terminable() -> Iterator[None]:
    """SIGTERM ends the process as an exception does; a run that is trained in the block listens for itself."""

    def end(number: int, _: FrameType | None) -> NoReturn:
        sys.exit(128 + number)

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _ending(folders: Sequence[RunFolder], error: BaseException | None) -> tuple[Status, str]:
    failures = [f"{folder.name}: {folder.error}" for folder in folders if folder.state == "failed"]
    if failures:
        return "FAILED", "\n".join([f"{len(failures)} of {len(folders)} runs failed", *failures])
    if error is None and all(folder.state == "done" for folder in folders):
        return "FINISHED", ""
    ran_out_of_time = isinstance(error, Fault) and error.exit_code == 124
    if isinstance(error, Exception) and not ran_out_of_time:
        return "FAILED", str(error)
    return "KILLED", ""


def _describe(journal: Journal, jobs: Sequence[Job], folders: Sequence[RunFolder]) -> None:
    """Write the sweep's table to its page."""
    head = ("run", "state", "steps", "mean", "+-", "median", "IQM", "high", "low", "hours")
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * 2}{' ---: |' * 8}"]
    failures = []
    for job, folder in zip(jobs, folders, strict=True):
        row = [job.title, folder.state]
        if (result := folder.result) is not None:
            scores = [
                f"{result.evaluation[f'evaluation/{point}']:,.0f}" for point in TABLE_COLUMNS if result.evaluation
            ]
            hours = f"{result.counts['hours']:.2f}" if "hours" in result.counts else ""
            row += [f"{result.steps:,}", *(scores or [""] * len(TABLE_COLUMNS)), hours]
        lines.append(f"| {' | '.join(row + [''] * (len(head) - len(row)))} |")
        if folder.state == "failed":
            told = f" (`{TRACEBACK}` of the run tells all)" if (folder.path / TRACEBACK).exists() else ""
            failures.append(f"- **{job.title} failed**: {folder.error}{told}")
    groups = [
        f"| {name} | {len(means)} | {np.mean(means):,.0f} | {min(means):,.0f} | {max(means):,.0f} |"
        for name, (_, means) in _evaluations(jobs, folders).items()
    ]
    summary = ["| group | runs | mean of the means | lowest | highest |\n| --- | ---: | ---: | ---: | ---: |", *groups]
    parts = [
        fitted(summary, NOTE_LENGTH // 4, "`runs.csv`") if groups else "",
        fitted(failures, NOTE_LENGTH // 4, "`runs.csv`"),
        "Figures: `curves.png`, `scores.png`.",
    ]
    above = "\n\n".join(part for part in parts if part)
    journal.note(f"{above}\n\n{fitted(lines, NOTE_LENGTH - len(above), '`runs.csv`')}")
    journal.flush()


def _draw(journal: Journal, jobs: Sequence[Job], folders: Sequence[RunFolder], was_complete: bool) -> None:
    """Write the sweep's figures and its table of numbers; the figures also as pictures once all runs have ended."""
    is_complete = all(folder.state == "done" for folder in folders)
    trained: dict[str, tuple[str, list[list[tuple[float, float]]]]] = {}
    for job, folder in zip(jobs, folders, strict=True):
        trained.setdefault(job.group, (job.colour, []))[1].append(_curve(folder, "score/mean_100"))
    figures = {"curves": curves(trained, "step", "score, mean of 100 episodes")}
    if evaluated := _evaluations(jobs, folders):
        figures["scores"] = strips(evaluated, "mean score of the last evaluation, a dot a run")
    for name, picture in figures.items():
        journal.artifact(f"{name}.png", picture)
        if is_complete and not was_complete:
            journal.image(f"sweep/{name}", picture, 0)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    rows: list[dict[str, Any]] = []
    for job, folder in zip(jobs, folders, strict=True):
        result = folder.result
        numbers = {"steps": result.steps, **result.counts, **result.evaluation} if result else {}
        rows.append({"run": folder.name, "title": job.title, "state": folder.state, **numbers})
    head = list(dict.fromkeys(key for row in rows for key in row))
    writer.writerow(head)
    writer.writerows([row.get(key, "") for key in head] for row in rows)
    journal.artifact("runs.csv", text.getvalue().encode())


def _evaluations(jobs: Sequence[Job], folders: Sequence[RunFolder]) -> dict[str, tuple[str, list[float]]]:
    """The colour of each group and the evaluated means of its runs."""
    groups: dict[str, tuple[str, list[float]]] = {}
    for job, folder in zip(jobs, folders, strict=True):
        if (result := folder.result) is not None and result.evaluation:
            groups.setdefault(job.group, (job.colour, []))[1].append(result.evaluation["evaluation/mean"])
    return groups


def _curve(folder: RunFolder, key: str) -> list[tuple[float, float]]:
    with suppress(ValueError, OSError):  # of a journal that was damaged: the run's own command says so
        return [(record.step, record.values[key]) for record in curve(folder.path, [key])]
    return []
