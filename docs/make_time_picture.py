"""Draw `docs/images/NAME.png` from `docs/data/NAME.csv`: scores of our recipe and of peers by training time.

`python docs/make_time_picture.py NAME [OUTPUTS...]`, from the root of the checkout. OUTPUTS are files with the output
of `python -m benchmarks.time_to_score`, whose curves then replace the table.
"""

import csv
import json
from collections.abc import Sequence
from itertools import accumulate, groupby
from pathlib import Path

from make_results_picture import columns
from matplotlib.figure import Figure
from tables import arguments

from atlantis_exp.comparison.figures import thousands
from atlantis_exp.media import BLUE, GREEN, GREY, VERMILLION
from benchmarks.time_to_score import GOALS

COLUMNS = ("program", "hours", "steps", "score")
SHOWN = {
    "ours": ("experiment=fast", BLUE, "o"),
    "sb3_qrdqn": ("sb3-contrib's QR-DQN, RL Zoo's settings", VERMILLION, "s"),
    "cleanrl_dqn": ("Stable-Baselines3's DQN, CleanRL's settings", GREEN, "^"),
}


def take_over(outputs: Sequence[Path], table: Path) -> None:
    """Rewrite the table from the benchmark's output."""
    with table.open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(COLUMNS)
        for output in outputs:
            for program, turns in json.loads(output.read_text().splitlines()[-1])["curves"].items():
                hours = accumulate(turn[0] for turn in turns)
                rows.writerows(
                    (program, f"{now:.4f}", turn[1], turn[2]) for now, turn in zip(hours, turns, strict=True)
                )


def main(name: str, outputs: Sequence[Path]) -> None:
    """Update the table; draw a line a program, and the goals."""
    table = Path(f"docs/data/{name}.csv")
    if outputs:
        take_over(outputs, table)
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    figure = Figure(figsize=(7, 4), dpi=100, layout="constrained")
    axes = figure.subplots()
    for program, points in groupby(rows, key=lambda row: row["program"]):
        label, colour, mark = SHOWN[program]
        curve = columns(list(points), "hours", "score", 1 / 60)
        axes.plot(*curve, color=colour, marker=mark, markersize=4, linewidth=1.2, label=label)
    last = 60 * max(float(row["hours"]) for row in rows)
    for goal, what in zip(GOALS, ("the report's best mean", "its best game"), strict=True):
        axes.axhline(goal, color=GREY, linestyle=":", linewidth=1)
        axes.text(last, goal, f"{what}, {goal:,}", color=GREY, fontsize="small", ha="right", va="top")
    axes.set(yscale="log", xlabel="minutes of training on two cores", ylabel="mean score of five games")
    axes.set_xlim(left=0)
    thousands(axes.yaxis)
    axes.legend(frameon=False, fontsize="small")
    figure.savefig(f"docs/images/{name}.png")


if __name__ == "__main__":
    asked = arguments(__doc__, ("time_to_score", "time_to_score_longer"))
    main(asked.name, asked.outputs)
