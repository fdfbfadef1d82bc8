"""Draw `docs/images/NAME.png` from `docs/data/NAME.csv`: scores in the field's game next to published curves.

`python docs/make_standard_picture.py NAME [OUTPUTS...]`, from the root of the checkout, where NAME is `standard`,
`rewards` or `million`. First it adds the trainings in the folders OUTPUTS to the table, replacing runs of the same
names.
"""

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from make_results_picture import columns, rows_with
from matplotlib.figure import Figure
from tables import arguments

from atlantis_exp.comparison.figures import thousands
from atlantis_exp.comparison.published import curves
from atlantis_exp.components import game_of
from atlantis_exp.media import BLUE, GREEN, GREY

PUBLISHED = {"DreamerV3": "s", "QR-DQN Impala ResNet": "^", "QR-DQN Nature CNN": "v"}
SEEDS = (("-", "o"), ("--", "X"), (":", "D"))  # line of training, mark of evaluations
TRAINED = {
    "standard": "rewards of at most 1",
    "rewards": "rewards to the power of .25",
    "million": "rewards to the power of .25",
}
FRAMES = 4  # a step


def main(name: str, outputs: Sequence[Path]) -> None:
    """Update the table and draw a line a training, with a point for each evaluation."""
    rows = rows_with(outputs, Path(f"docs/data/{name}.csv"))
    figure = Figure(figsize=(7, 4.5), dpi=100, layout="constrained")
    axes = figure.subplots()
    for run, points in groupby(rows, key=lambda row: row["run"]):
        training, (network, _, seed, _) = list(points), run.split("-")
        evaluated = [row for row in training if row["evaluation"]]
        line, mark = SEEDS[int(seed.removeprefix("s"))]
        colour, what = (GREEN, "layer normalization, too") if network == "cnn_norm" else (BLUE, TRAINED[name])
        axes.plot(*columns(training, "step", "mean_20", 1e6 / FRAMES), color=colour, linestyle=line, linewidth=1)
        axes.plot(*columns(evaluated, "step", "evaluation", 1e6 / FRAMES), mark, color=colour)
        label = f"{what}, seed {seed.removeprefix('s')}"
        axes.plot([], [], color=colour, linestyle=line, marker=mark, linewidth=1, label=label)
    last = max(FRAMES * int(row["step"]) for row in rows) / 1e6
    for agent, mark in PUBLISHED.items():
        known = [row for row in curves(game_of("Atlantis-v0")) if row["name"] == agent]
        shown = [(row["frames"] / 1e6, row["mean"]) for row in known if row["frames"] / 1e6 <= round(last)]
        axes.plot(
            *zip(*shown, strict=True), color=GREY, marker=mark, markersize=4, linewidth=0.8, label=f"{agent}, published"
        )
    axes.set(yscale="log", xlabel="million frames", ylabel="score: mean of 20 in training, evaluations as points")
    thousands(axes.yaxis)
    axes.legend(frameon=False, fontsize="small")
    figure.savefig(f"docs/images/{name}.png")


if __name__ == "__main__":
    asked = arguments(__doc__, TRAINED)
    main(asked.name, asked.outputs)
