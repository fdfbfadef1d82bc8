"""A sweep as a run of its own: what its runs are shown under, with their table and figures on its page."""

import csv
import io
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from multiprocessing import resource_tracker
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, get_args

import numpy as np

from atlantis_exp.commands.app import BASIC, Launcher
from atlantis_exp.commands.live import LiveTable
from atlantis_exp.commands.runs import RunFolder, State, provenance, published, settle
from atlantis_exp.commands.slurm import all_awaited
from atlantis_exp.commands.titles import colour, group, title
from atlantis_exp.config import Config, digest
from atlantis_exp.faults import Fault
from atlantis_exp.media import curves, strips
from atlantis_exp.statistics import TABLE_COLUMNS
from atlantis_exp.tracking.journal import Journal, JournalError, Status, adopt, curve, read_commit
from atlantis_exp.tracking.store import TRACEBACK

_PAGE_SECONDS = 60.0  # between two looks at the runs while they are trained
_STOP_SECONDS = 300.0  # that jobs have to commit once their sweep ends


@contextmanager
def ledger(configs: Sequence[Config], swept: Sequence[str], launcher: Launcher = BASIC) -> Iterator[None]:
    """Print a sweep's table of runs before and after it, and keep a page of it in MLflow (tracking=mlflow).

    Where a launcher runs the jobs in other processes, these write their folders only: this one shows how they get on,
    publishes them, and, but for Slurm's, has them commit before it ends itself.

    Whatever process trains them, the runs know their parent from their folders, where it stands before the first
    starts. The same set of runs is the same parent again. However the block ends, the page is closed with it.

    swept: the overrides that name several values, as typed.

    Raises:
        Fault: while another process runs the same sweep.
    """
    configs = list({config.run_name(): config for config in configs}.values())
    folders = [RunFolder.of(config) for config in configs]
    _print_table(folders)
    try:
        if launcher.is_basic and configs[0].tracking.name == "none":
            yield
        else:
            with _page(configs, folders, swept, launcher):
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
    return f": {folder.error}" + (f" ({path})" if folder.state == "failed" and path.exists() else "")


@contextmanager
def _page(
    configs: Sequence[Config], folders: Sequence[RunFolder], swept: Sequence[str], launcher: Launcher
) -> Iterator[None]:
    outputs = Path(configs[0].paths.outputs)
    identity = digest({"runs": sorted(folder.name for folder in folders)})
    sweep = RunFolder(outputs / "sweeps" / f"sweep-{identity}")
    labels = {"mlflow.runName": f"sweep {' '.join(swept)}", "atlantis.kind": "training sweep"}
    if not launcher.is_basic:
        settle(outputs)  # which the jobs leave to this process
    others = () if launcher.is_basic else folders
    with sweep.held(), _terminable():
        for folder in folders:
            with suppress(Fault, JournalError), folder.held():  # what runs elsewhere stays where it is
                adopt(folder.path, sweep.path)
        with published(sweep, configs[0].tracking, outputs, labels, others) as journal:
            if (commit := read_commit(sweep.path)) is not None and commit.offset:
                journal.load_state_dict({"offset": commit.offset, "time": commit.updated})
            journal.tags(provenance())
            _describe(journal, configs, folders)
            journal.status("RUNNING")
            error: BaseException | None = None
            try:
                with (
                    _every(_PAGE_SECONDS, lambda: _describe(journal, configs, folders)) as close,
                    nullcontext() if launcher.is_basic else _jobs(journal, configs, folders, launcher, close),
                ):
                    yield
            except BaseException as raised:
                error = raised
                raise
            finally:
                status, reason = _ending(folders, error)
                try:
                    _draw(journal, configs, folders, commit is not None and commit.status == "FINISHED")
                    _describe(journal, configs, folders)
                finally:
                    journal.status(status, reason)


@contextmanager
def _every(seconds: float, look: Callable[[], None]) -> Iterator[Callable[[], None]]:
    """Calls `look` now and then in a thread, until the block or a call of what it yields ends."""
    closing = threading.Event()

    def run() -> None:
        while not closing.wait(seconds):
            with suppress(OSError, Fault):  # the next look may fare better
                look()

    def close() -> None:
        closing.set()
        thread.join()

    thread = threading.Thread(target=run, name=f"every {seconds:g} s", daemon=True)
    thread.start()
    try:
        yield close
    finally:
        close()


@contextmanager
def _jobs(
    journal: Journal,
    configs: Sequence[Config],
    folders: Sequence[RunFolder],
    launcher: Launcher,
    close_page: Callable[[], None],
) -> Iterator[None]:
    """The jobs of a launcher: shown live, with a share of the cores each, and stopped before the sweep ends.

    SIGINT and SIGTERM have them commit while this process waits; then it exits as a run would.
    """
    if launcher.name not in ("joblib", "ray"):  # what a cluster was given, it does
        with _shown(configs, folders), all_awaited() if launcher.name == "slurm" else nullcontext():
            yield
        return

    def stop() -> None:
        close_page()  # it writes the journal, too
        patience = time.monotonic() + _STOP_SECONDS
        if any(folder.is_held for folder in own):
            journal.status("KILLED")  # the jobs look at it
            while any(folder.is_held for folder in own) and time.monotonic() < patience:
                time.sleep(0.2)

    exit_code: int | None = None

    def end(number: int, _: FrameType | None) -> NoReturn:
        nonlocal exit_code
        exit_code = 128 + number
        signal.signal(number, signal.SIG_DFL)  # a second one ends the process at once
        print(f"atlantis_exp: {signal.Signals(number).name}: the jobs commit and end", file=sys.stderr, flush=True)
        stop()
        sys.exit(exit_code)

    own = [folder for folder in folders if not folder.is_held]
    if launcher.ray is not None:
        _start_ray(launcher.ray)
    handlers = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    with _shown(configs, folders), _shared_cores(launcher, folders):
        if launcher.name == "joblib":
            from joblib.externals.loky.backend import resource_tracker as its_own

            for tracker in (resource_tracker, its_own):
                tracker.ensure_running()  # started later, it would lift the mask
        # A worker of joblib's that a signal ends would take all others along: they inherit this mask. The signals reach
        # this process all the same, through its other threads.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, handlers if launcher.name == "joblib" else ())
        try:
            yield
        except SystemExit as exiting:
            if exit_code is not None:
                exiting.code = exit_code  # which Ray replaces by 1
            raise
        finally:
            stop()
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
            for number, handler in handlers.items():
                signal.signal(number, handler)


def _start_ray(settings: Mapping[str, Any]) -> None:
    """Start Ray, or join a cluster, before the launcher does: it puts a handler of its own on SIGTERM."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if settings.get("address") is None and "RAY_ADDRESS" not in os.environ:
        os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")  # what is started listens to 127.0.0.1 only
    import ray

    ray.init(**settings)


@contextmanager
def _shown(configs: Sequence[Config], folders: Sequence[RunFolder]) -> Iterator[None]:
    table = LiveTable(configs, folders)
    try:
        with _every(table.seconds, table.look):
            yield
    finally:
        table.close()


@contextmanager
def _shared_cores(launcher: Launcher, folders: Sequence[RunFolder]) -> Iterator[None]:
    """Tells joblib's workers their share of the cores, unless a person has; Ray and Slurm do it themselves."""
    if launcher.name != "joblib" or "OMP_NUM_THREADS" in os.environ:
        yield
        return
    from joblib import cpu_count, effective_n_jobs

    jobs = min(effective_n_jobs(launcher.n_jobs), sum(folder.state != "done" for folder in folders))
    share = str(max(cpu_count() // max(jobs, 1), 1))
    os.environ |= {"OMP_NUM_THREADS": share, "MKL_NUM_THREADS": share}
    try:
        yield
    finally:
        del os.environ["OMP_NUM_THREADS"], os.environ["MKL_NUM_THREADS"]


@contextmanager
def _terminable() -> Iterator[None]:
    """SIGTERM between two runs ends the process as an exception does; a run listens for itself."""

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


def _describe(journal: Journal, configs: Sequence[Config], folders: Sequence[RunFolder]) -> None:
    """Write the sweep's table to its page."""
    head = ("run", "state", "steps", "mean", "+-", "median", "IQM", "high", "low", "hours")
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * 2}{' ---: |' * 8}"]
    failures = []
    for config, folder in zip(configs, folders, strict=True):
        row = [title(config), folder.state]
        if (result := folder.result) is not None:
            scores = [
                f"{result.evaluation[f'evaluation/{point}']:,.0f}" for point in TABLE_COLUMNS if result.evaluation
            ]
            row += [f"{result.steps:,}", *(scores or [""] * len(TABLE_COLUMNS)), f"{result.counts['hours']:.2f}"]
        lines.append(f"| {' | '.join(row + [''] * (len(head) - len(row)))} |")
        if folder.state == "failed":
            told = f" (`{TRACEBACK}` of the run tells all)" if (folder.path / TRACEBACK).exists() else ""
            failures.append(f"**{title(config)} failed**: {folder.error}{told}")
    groups = [
        f"| {name} | {len(means)} | {np.mean(means):,.0f} | {min(means):,.0f} | {max(means):,.0f} |"
        for name, (_, means) in _evaluations(configs, folders).items()
    ]
    summary = ["| group | runs | mean of the means | lowest | highest |\n| --- | ---: | ---: | ---: | ---: |", *groups]
    parts = ["\n".join(lines), *failures, "\n".join(summary) if groups else "", "Figures: `curves.png`, `scores.png`."]
    journal.note("\n\n".join(part for part in parts if part))
    journal.state_dict()
    journal.commit()


def _draw(journal: Journal, configs: Sequence[Config], folders: Sequence[RunFolder], was_complete: bool) -> None:
    """Write the sweep's figures and its table of numbers; the figures also as pictures once all runs have ended."""
    is_complete = all(folder.state == "done" for folder in folders)
    trained: dict[str, tuple[str, list[list[tuple[float, float]]]]] = {}
    for config, folder in zip(configs, folders, strict=True):
        trained.setdefault(group(config), (colour(config), []))[1].append(_curve(folder, "score/mean_100"))
    figures = {"curves": curves(trained, "step", "score, mean of 100 episodes")}
    if evaluated := _evaluations(configs, folders):
        figures["scores"] = strips(evaluated, "mean score of the last evaluation, a dot a run")
    for name, picture in figures.items():
        journal.artifact(f"{name}.png", picture)
        if is_complete and not was_complete:
            journal.image(f"sweep/{name}", picture, 0)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    rows: list[dict[str, Any]] = []
    for config, folder in zip(configs, folders, strict=True):
        result = folder.result
        numbers = {"steps": result.steps, **result.counts, **result.evaluation} if result else {}
        rows.append({"run": folder.name, "title": title(config), "state": folder.state, **numbers})
    head = list(dict.fromkeys(key for row in rows for key in row))
    writer.writerow(head)
    writer.writerows([row.get(key, "") for key in head] for row in rows)
    journal.artifact("runs.csv", text.getvalue().encode())


def _evaluations(configs: Sequence[Config], folders: Sequence[RunFolder]) -> dict[str, tuple[str, list[float]]]:
    """The colour of each group and the evaluated means of its runs."""
    groups: dict[str, tuple[str, list[float]]] = {}
    for config, folder in zip(configs, folders, strict=True):
        if (result := folder.result) is not None and result.evaluation:
            groups.setdefault(group(config), (colour(config), []))[1].append(result.evaluation["evaluation/mean"])
    return groups


def _curve(folder: RunFolder, key: str) -> list[tuple[float, float]]:
    with suppress(ValueError, OSError):  # of a journal that was damaged: the run's own command says so
        return [(record.step, record.values[key]) for record in curve(folder.path, [key])]
    return []
