"""The results that the outputs folder holds, as a table."""

from collections.abc import Mapping
from pathlib import Path

from rich.table import Table

from atlantis_exp import terminal
from atlantis_exp.config import PathsConfig
from atlantis_exp.faults import Fault
from atlantis_exp.registry import TABLE_COLUMNS
from atlantis_exp.runs.folder import EVALUATED, RunFolder, all_runs
from atlantis_exp.runs.journal import Metrics, read
from atlantis_exp.tracking.publishing import catch_up
from atlantis_exp.tracking.views import how_to_open


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
    for run in runs:
        step, evaluation = _last_evaluation(run)
        reached = f"{step:,}" if run.result is not None else f"{step:,} ({run.state})" if evaluation else run.state
        table.add_row(run.name, reached, *_cells(evaluation))
    console = terminal.console(least=150)
    console.print(table)
    for run in runs:
        if run.result is not None:
            console.print(f"\n{run.name}\n{run.result.report}")
    console.print(f"\n{how_to_open(outputs)}")


def _last_evaluation(run: RunFolder) -> tuple[int, Mapping[str, float]]:
    """At which step a run was evaluated last, and its metrics; none where there was no evaluation yet.

    Raises: Fault, where its journal is damaged.
    """
    if (result := run.result) is not None:
        return result.steps, result.evaluation
    try:
        evaluations = [
            (record.step, record.values)
            for _, record in read(run.path)
            if isinstance(record, Metrics) and record.values.keys() >= EVALUATED
        ]
    except ValueError as error:
        raise Fault(f"run {run.name}: {error}") from error
    return evaluations[-1] if evaluations else (0, {})


def _cells(evaluation: Mapping[str, float]) -> list[str]:
    if not evaluation:
        return []
    return [
        *(f"{evaluation[f'evaluation/{point}']:,.0f}" for point in TABLE_COLUMNS),
        f"{evaluation['actions/random_share']:.1%}",
        f"{evaluation['evaluation/episodes']:.0f}",
    ]
