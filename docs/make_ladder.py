"""Draw `docs/images/ladder.png` from `docs/data/ladder.csv` and print the table of lab/results.md.

`python docs/make_ladder.py [OUTPUTS...]`, from the root of the checkout. First it adds the finished trainings in the
folders OUTPUTS to the data, replacing runs of the same names.
"""

import csv
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from tables import RANDOM, Row, arguments, updated

from atlantis_exp.media import GREY
from atlantis_exp.runs.folder import RunFolder, all_runs, evaluation_at
from atlantis_exp.runs.journal import Tags, curve, read
from atlantis_exp.statistics import interquartile_mean

DATA = Path("docs/data/ladder.csv")
COLUMNS = ("run", "command", "commit", "updates", "hours", "steps", "training", "evaluation")
EVERY = 5_000  # steps between two points of a curve
# Options that the text above the table gives once.
COMMON = ("seed=", "threads=", "env.workers=", "phase=brief", "evaluation.")


def main(outputs: Sequence[Path]) -> None:
    """Update the data, draw it, and print every run's mean with its interval."""
    runs = [run for folder in outputs for run in all_runs(folder) if run.result]
    rows = updated(DATA, COLUMNS, {run.name for run in runs}, map(row_of, runs), lambda row: (label(row), row["run"]))
    ladder = [row for row in rows if "experiment=ablation" in row["command"]]
    draw(ladder, [row for row in rows if row not in ladder])
    for row in rows:
        scores, (low, high) = estimates(row)
        print(
            f"| `{label(row)}` | {scores.mean():,.0f} | {low:,.0f} to {high:,.0f} | {interquartile_mean(scores):,.0f} "
            f"| {numbers(row['training'])[-1]:,.0f} | {int(row['updates']):,} | {float(row['hours']):.2f} |"
        )


def row_of(run: RunFolder) -> Row:
    """Return a finished training's row: its command, costs, curve and evaluated scores."""
    assert run.result is not None
    tags = {
        key: value for _, record in read(run.path) if isinstance(record, Tags) for key, value in record.values.items()
    }
    points: dict[int, float] = {}
    for record in curve(run.path, ("score/mean_20",)):
        points.setdefault(record.step // EVERY * EVERY, record.values["score/mean_20"])
    with run.artifact(evaluation_at(run.result.steps)).open() as file:
        scores = [f"{float(episode['score']):.0f}" for episode in csv.DictReader(file)]
    values = (
        run.name,
        tags["command"].removeprefix("python -m atlantis_exp "),
        tags["git.commit"][:7],
        f"{run.result.counts['updates']:.0f}",
        f"{run.result.counts['hours']:.3f}",
        " ".join(str(step) for step in points),
        " ".join(f"{score:.0f}" for score in points.values()),
        " ".join(scores),
    )
    return dict(zip(COLUMNS, values, strict=True))


def label(row: Row) -> str:
    """Return the distinctive part of a run's command."""
    words = [word for word in row["command"].split() if not word.startswith(COMMON)]
    return " ".join(words).removeprefix("experiment=").removeprefix("ablation_")


def numbers(text: str) -> npt.NDArray[np.float64]:
    return np.array(text.split(), np.float64)


def estimates(row: Row) -> tuple[npt.NDArray[np.float64], tuple[float, float]]:
    """Return the evaluated scores, and the bootstrap's 95 % interval of their mean over episodes."""
    scores, rng = numbers(row["evaluation"]), np.random.default_rng(0)
    drawn = (rng.integers(np.full(scores.size, scores.size)) for _ in range(2_000))
    low, high = np.percentile([scores[chosen].mean() for chosen in drawn], (2.5, 97.5))
    return scores, (float(low), float(high))


def draw(ladder: Sequence[Row], branches: Sequence[Row]) -> None:
    """Draw curves of the rungs and of the branches, and the means of all."""
    figure = Figure(figsize=(13, 6.5), dpi=100, layout="constrained")
    panels = figure.subplots(1, 3, width_ratios=(1, 1, 1.2))
    means = panels[2]
    position = 0
    for axes, rows, name, heading in (
        (panels[0], ladder, "viridis_r", "from the report's recipe ..."),
        (panels[1], branches, "plasma", "... and from experiment=fast"),
    ):
        colours = matplotlib.colormaps[name](np.linspace(0.05, 0.9, len(rows)))
        for row, colour in zip(rows, colours, strict=True):
            axes.plot(
                numbers(row["steps"]) / 1e3, numbers(row["training"]), color=colour, linewidth=1, label=label(row)
            )
            scores, (low, high) = estimates(row)
            means.plot([low, high], [position, position], color=colour, linewidth=4, solid_capstyle="butt", alpha=0.5)
            means.plot(scores.mean(), position, "o", color=colour)
            means.text(high, position, f"  {label(row).removeprefix('fast ')}", va="center", fontsize="small")
            position -= 1
        axes.set(xlabel="thousand steps", title=heading, ylim=(0, None))
        axes.axhline(RANDOM, color=GREY, linestyle=":", linewidth=1)
        axes.legend(frameon=False, fontsize="x-small", loc="upper center", bbox_to_anchor=(0.5, -0.11))
    panels[0].set(ylabel="training score, mean of 20 episodes")
    means.set(title="evaluation, mean and 95 % over episodes", xlabel="score", yticks=[])
    means.set(xlim=(0, 2 * means.get_xlim()[1]))
    means.axvline(RANDOM, color=GREY, linestyle=":", linewidth=1)
    figure.savefig("docs/images/ladder.png")


if __name__ == "__main__":
    main(arguments(__doc__).outputs)
