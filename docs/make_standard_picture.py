"""Draw `docs/images/standard.png` from `docs/data/standard.csv`: scores in the field's game next to published curves.

`python docs/make_standard_picture.py [OUTPUTS...]`, from the root of the checkout. The trainings in the folders OUTPUTS
enter the table first, in the place of what it has of runs of the same names.
"""

import sys
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from make_results_picture import columns, rows_with
from matplotlib.figure import Figure

from atlantis_exp.comparison.figures import thousands
from atlantis_exp.comparison.published import curves
from atlantis_exp.components import game_of
from atlantis_exp.media import BLUE, GREY

PUBLISHED = {"DreamerV3": "s", "QR-DQN Impala ResNet": "^", "QR-DQN Nature CNN": "v"}
SEEDS = (("-", "o"), ("--", "X"), (":", "D"))  # line of training, mark of evaluations
FRAMES = 4  # a step


def main(outputs: Sequence[Path]) -> None:
    """Bring the table up to date and draw a line a training, with a point for each evaluation."""
    rows = rows_with(outputs, Path("docs/data/standard.csv"))
    figure = Figure(figsize=(7, 4.5), dpi=100, layout="constrained")
    axes = figure.subplots()
    for run, points in groupby(rows, key=lambda row: row["run"]):
        training, seed = list(points), int(run.split("-")[2].removeprefix("s"))
        evaluated = [row for row in training if row["evaluation"]]
        line, mark = SEEDS[seed]
        axes.plot(*columns(training, "step", "mean_20", 1e6 / FRAMES), color=BLUE, linestyle=line, linewidth=1)
        axes.plot(*columns(evaluated, "step", "evaluation", 1e6 / FRAMES), mark, color=BLUE)
        axes.plot([], [], color=BLUE, linestyle=line, marker=mark, linewidth=1, label=f"seed {seed}")
    last = max(FRAMES * int(row["step"]) for row in rows) / 1e6
    for name, mark in PUBLISHED.items():
        known = [row for row in curves(game_of("Atlantis-v0")) if row["name"] == name]
        shown = [(row["frames"] / 1e6, row["mean"]) for row in known if row["frames"] / 1e6 <= round(last)]
        axes.plot(
            *zip(*shown, strict=True), color=GREY, marker=mark, markersize=4, linewidth=0.8, label=f"{name}, published"
        )
    axes.set(yscale="log", xlabel="million frames", ylabel="score: mean of 20 in training, evaluations as points")
    thousands(axes.yaxis)
    axes.legend(frameon=False, fontsize="small")
    figure.savefig("docs/images/standard.png")


if __name__ == "__main__":
    main([Path(folder) for folder in sys.argv[1:]])
