"""The results that the outputs folder holds, as a table."""

from collections.abc import Mapping
from pathlib import Path

from rich.table import Table

from atlantis_exp import terminal
from atlantis_exp.config import PathsConfig
from atlantis_exp.runs.folder import EVALUATED, TABLE_COLUMNS, RunFolder, all_runs
from atlantis_exp.runs.journal import Metrics
from atlantis_exp.tracking.publishing import catch_up, how_to_open


def report(*, paths: PathsConfig) -> None:
    """Print every run's evaluation, and how to look further."""
    outputs = Path(paths.outputs)
    catch_up(outputs)
    runs = all_runs(outputs)
    if not runs:
        print(f"there is no run under {outputs / 'runs'} yet")
        return
    shown = outputs.relative_to(Path.cwd()) if outputs.is_relative_to(Path.cwd()) else outputs
    columns = ("run", "steps", "mean", "+-", "median", "IQM", "high", "low", "random", "episodes")
    table = Table(*columns, title=f"last evaluations of the runs in {shown}")
    for column in table.columns[1:]:
        column.justify = "right"
    results = [run.final_result for run in runs]
    for run, result in zip(runs, results, strict=True):
        if result is not None:
            earlier = f" (evaluated at {result.evaluated_at:,})" if result.evaluated_at is not None else ""
            table.add_row(run.name, f"{result.steps:,}{earlier}", *_cells(result.evaluation))
            continue
        step, evaluation = _last_evaluation(run)
        table.add_row(run.name, f"{step:,} ({run.state})" if evaluation else run.state, *_cells(evaluation))
    console = terminal.console(least=150)
    console.print(table)
    for run, result in zip(runs, results, strict=True):
        if result is not None:
            console.print(terminal.harmless(f"\n{run.name}\n{result.report}"))
    console.print(how_to_open(outputs), end="")


def _last_evaluation(run: RunFolder) -> tuple[int, Mapping[str, float]]:
    """At which step a run that goes on was evaluated last, and its metrics; none where there was no evaluation yet.

    Raises: Fault, where its journal is damaged.
    """
    found: tuple[int, Mapping[str, float]] = (0, {})
    for record in run.records():
        if isinstance(record, Metrics) and record.values.keys() >= EVALUATED:
            found = record.step, record.values
    return found


def _cells(evaluation: Mapping[str, float]) -> list[str]:
    if not evaluation:
        return []
    return [
        *(f"{evaluation[f'evaluation/{point}']:,.0f}" for point in TABLE_COLUMNS),
        f"{evaluation['actions/random_share']:.1%}",
        f"{evaluation['evaluation/episodes']:.0f}",
    ]
