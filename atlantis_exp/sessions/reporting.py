"""The results that the outputs folder holds, as a table."""

from pathlib import Path

from rich.table import Table

from atlantis_exp import terminal
from atlantis_exp.config import PathsConfig
from atlantis_exp.registry import TABLE_COLUMNS
from atlantis_exp.runs.folder import all_runs
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
        result = run.result
        if result is None or not result.evaluation:
            table.add_row(run.name, run.state if result is None else f"{result.steps:,}")
            continue
        scores = {key.split("/")[1]: value for key, value in result.evaluation.items() if key.startswith("evaluation/")}
        table.add_row(
            run.name,
            f"{result.steps:,}",
            *(f"{scores[point]:,.0f}" for point in TABLE_COLUMNS),
            f"{result.evaluation['actions/random_share']:.1%}",
            f"{scores['episodes']:.0f}",
        )
    console = terminal.console(least=130)
    console.print(table)
    for run in runs:
        if run.result is not None:
            console.print(f"\n{run.name}\n{run.result.report}")
    console.print(f"\n{how_to_open(outputs)}")
