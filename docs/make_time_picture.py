"""Draw `docs/images/time_to_score.png` from `docs/data/time_to_score.csv`: scores of three programs by training time.

`python docs/make_time_picture.py [OUTPUT]`, from the root of the checkout. OUTPUT is a file with what
`python -m benchmarks.time_to_score` printed, whose curves then take the table's place.
"""

import csv
import json
import sys
from itertools import accumulate, groupby
from pathlib import Path

from make_results_picture import columns
from matplotlib.figure import Figure

from atlantis_exp.comparison.figures import thousands
from atlantis_exp.media import BLUE, GREEN, GREY, VERMILLION
from benchmarks.time_to_score import GOALS

TABLE = Path("docs/data/time_to_score.csv")
COLUMNS = ("program", "hours", "steps", "score")
SHOWN = {
    "ours": ("experiment=fast", BLUE, "o"),
    "sb3_qrdqn": ("sb3-contrib's QR-DQN, RL Zoo's settings", VERMILLION, "s"),
    "cleanrl_dqn": ("Stable-Baselines3's DQN, CleanRL's settings", GREEN, "^"),
}


def take_over(output: Path) -> None:
    """Write the table anew from what the benchmark printed."""
    curves = json.loads(output.read_text().splitlines()[-1])["curves"]
    with TABLE.open("w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        for program, turns in curves.items():
            hours = accumulate(turn[0] for turn in turns)
            table.writerows((program, f"{now:.4f}", turn[1], turn[2]) for now, turn in zip(hours, turns, strict=True))


def main() -> None:
    """Draw a line a program, and the goals."""
    with TABLE.open(newline="") as file:
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
    figure.savefig("docs/images/time_to_score.png")


if __name__ == "__main__":
    if arguments := sys.argv[1:]:
        take_over(Path(arguments[0]))
    main()
