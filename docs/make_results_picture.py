"""Draw `docs/images/fast.png` from `docs/data/fast.csv`: scores by steps and by hours.

`python docs/make_results_picture.py [OUTPUTS...]`, from the root of the checkout. First it adds the trainings in the
folders OUTPUTS to the table, replacing runs of the same names.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from itertools import cycle, groupby
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from tables import RANDOM, arguments, updated

from atlantis_exp.comparison.figures import thousands
from atlantis_exp.media import GREY, run_colour
from atlantis_exp.runs.folder import RunFolder, all_runs
from atlantis_exp.runs.journal import Metrics, read, read_commit

KEYS = {
    "hours": "throughput/hours",
    "updates": "learning/updates",
    "mean_20": "score/mean_20",
    "mean_100": "score/mean_100",
}
EVALUATION = "evaluation/mean"
COLUMNS = ("run", "step", *KEYS, "evaluation")
EVERY = 10_000  # steps between two rows of the table; evaluations have rows of their own


def main(outputs: Sequence[Path]) -> None:
    """Update the table and draw a line a run, in a constant colour, with a point for each evaluation."""
    rows = rows_with(outputs, Path("docs/data/fast.csv"))

    figure = Figure(figsize=(11, 4.5), dpi=100, layout="constrained")
    by_steps, by_hours = figure.subplots(1, 2, sharey=True)
    styles: defaultdict[str, Iterator[Any]] = defaultdict(lambda: cycle(("-", "--", "-.", ":", (0, (1, 3)))))
    for run, points in groupby(rows, key=lambda row: row["run"]):
        of_run, (model, sampler, _) = list(points), run.split("-", 2)
        colour = run_colour(model, sampler)
        style = next(styles[colour])
        evaluated = [row for row in of_run if row["evaluation"]]
        for axes, key, unit in ((by_steps, "step", 1e6), (by_hours, "hours", 1)):
            axes.plot(*columns(of_run, key, "mean_20", unit), color=colour, linestyle=style, label=run, linewidth=1)
            axes.plot(*columns(evaluated, key, "evaluation", unit), "o", color=colour)
    for axes in (by_steps, by_hours):
        axes.axhline(RANDOM, color=GREY, linestyle=":", linewidth=1)
    by_steps.set(yscale="log", xlabel="million steps", ylabel="score: mean of 20 in training, evaluations as points")
    thousands(by_steps.yaxis)
    by_steps.legend(frameon=False, fontsize="small")
    by_hours.set(xlabel="hours, whatever else the machine did")
    figure.savefig("docs/images/fast.png")


def rows_with(outputs: Sequence[Path], table: Path) -> list[dict[str, str]]:
    """Add the trainings in outputs folders to a table; return its rows."""
    runs = [run for folder in outputs for run in all_runs(folder)]
    new = (dict(zip(COLUMNS, row, strict=True)) for run in runs for row in rows_of(run))
    return updated(table, COLUMNS, {run.name for run in runs}, new, lambda row: (row["run"],))


def columns(rows: list[dict[str, str]], x: str, y: str, unit: float) -> tuple[list[float], list[float]]:
    """Return two columns as numbers."""
    return [float(row[x]) / unit for row in rows], [float(row[y]) for row in rows]


def rows_of(run: RunFolder) -> Iterator[list[str]]:
    """Yield a run's committed rows of the table."""
    commit = read_commit(run.path)
    if commit is None:  # only begun
        return
    latest: dict[str, float] = {}
    written = 0
    for _, record in read(run.path, 0, commit.offset):
        if not isinstance(record, Metrics):
            continue
        latest |= record.values
        evaluation = record.values.get(EVALUATION)
        if all(key in latest for key in KEYS.values()) and (evaluation or record.step >= written + EVERY):
            written = record.step
            values = (f"{latest[key]:.6g}" for key in KEYS.values())
            yield [run.name, f"{record.step}", *values, "" if evaluation is None else f"{evaluation:.6g}"]


if __name__ == "__main__":
    main(arguments(__doc__).outputs)
