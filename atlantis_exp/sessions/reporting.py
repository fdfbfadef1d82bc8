"""Print the results in the outputs folder as a table."""

from collections.abc import Mapping, Sequence
from math import isfinite
from pathlib import Path

from atlantis_exp import terminal
from atlantis_exp.documents import Report, Reported
from atlantis_exp.faults import Fault
from atlantis_exp.runs.folder import EVALUATED, TABLE_COLUMNS, RunFolder, all_runs, fits
from atlantis_exp.runs.journal import Metrics
from atlantis_exp.tracking.publishing import catch_up, how_to_open


def report(outputs: Path, runs: Sequence[str] = (), where: Sequence[str] = ()) -> None:
    """Print a line for each run with its last evaluation; `runs` and `where` select as in `compare`.

    Raises:
        ConfigError: if no run matches a text of `runs` or has a key of `where`.
        Fault: if a run's folder is damaged, once the others are printed.
    """
    catch_up(outputs)
    folders = _chosen(outputs, runs, where)
    reported, damaged = list[Reported](), list[str]()
    for run in folders:
        try:
            reported.append(_reported(run))
        except Fault as fault:
            damaged.append(f"left out {run.name}: {fault}")
    terminal.document(Report(runs=reported).model_dump_json())
    if not folders:
        print(f"no {'such ' if runs or where else ''}run under {outputs / 'runs'} yet")
        return
    shown = outputs.relative_to(Path.cwd()) if outputs.is_relative_to(Path.cwd()) else outputs
    columns = ("run", "steps", "mean", "+-", "median", "IQM", "high", "low", "random", "episodes")
    table = terminal.table(*columns, title=f"last evaluations of the runs in {shown}")
    for each in reported:
        earlier = f" (evaluated at {each.evaluated_at:,})" if each.evaluated_at not in (None, each.steps) else ""
        steps = f"{each.steps:,}{earlier if each.state == 'done' else f' ({each.state})'}"
        table.add_row(each.run, steps if each.evaluation or each.state == "done" else each.state, *_cells(each))
    console = terminal.console(least=150)
    console.print(table)
    console.print(how_to_open(outputs), end="", soft_wrap=True)  # a command to copy
    if damaged:
        raise Fault("; ".join(damaged))


def _reported(run: RunFolder) -> Reported:
    if (result := run.final_result) is None:
        steps, evaluation = _last_evaluation(run)
        at: int | None = steps
    else:
        steps, evaluation, at = result.steps, result.evaluation, result.evaluated_at
    return Reported(
        run=run.name,
        state=run.state,
        steps=steps,
        evaluated_at=(steps if at is None else at) if evaluation else None,
        evaluation={key: value for key, value in evaluation.items() if isfinite(value)},
    )


def _chosen(outputs: Path, runs: Sequence[str], where: Sequence[str]) -> list[RunFolder]:
    if not (runs or where):
        return all_runs(outputs)
    # Numpy takes a fifth of a second to import.
    from atlantis_exp.comparison.choosing import select
    from atlantis_exp.comparison.gather import named_by, read_runs, refuse_unknown

    refuse_unknown(outputs, runs)
    patterns = named_by(outputs, runs)
    folders = [run for run in all_runs(outputs) if fits(run.name, patterns)]
    if not where:
        return folders
    stored = read_runs(outputs, runs, put_aside=True)
    for name, reason in stored.skipped.items():
        terminal.warn(f"left out {name}: {reason}")
    names = {run.name for run in select(stored.runs, where)}
    return [run for run in folders if run.name in names]


def _last_evaluation(run: RunFolder) -> tuple[int, Mapping[str, float]]:
    """Return an unfinished run's last evaluation: step and metrics; none before the first. Raises: Fault."""
    found: tuple[int, Mapping[str, float]] = (0, {})
    for record in run.records():
        if isinstance(record, Metrics) and record.values.keys() >= EVALUATED:
            found = record.step, record.values
    return found


def _cells(reported: Reported) -> list[str]:
    formats = {f"evaluation/{point}": ",.0f" for point in TABLE_COLUMNS}
    formats |= {"actions/random_share": ".1%", "evaluation/episodes": ".0f"}
    there = reported.evaluation  # without numbers that are not finite
    return [f"{there[key]:{form}}" if key in there else "" for key, form in formats.items()]
