"""Draw `docs/images/precision.png`: the same seeds in bfloat16 and in float32, side by side.

`python docs/make_precision_picture.py OUTPUTS`, from the root of the checkout, where OUTPUTS is the folder that the
trainings of docs/performance.md wrote. Prints the means of the last evaluations.
"""

import sys
from collections import defaultdict
from pathlib import Path

from matplotlib.figure import Figure

from atlantis_exp.media import BLUE, VERMILLION
from atlantis_exp.runs.folder import all_runs
from atlantis_exp.runs.journal import Metrics, read, read_commit

PANELS = {
    "score/mean_20": "score, mean of 20 episodes",
    "learning/q": "mean value at s_t",
    "learning/loss": "loss",
    "learning/gradient_norm": "norm of the gradient",
}
COLOURS = {"bf16": BLUE, "fp32": VERMILLION}


def main(outputs: Path) -> None:
    """Read the journals and draw a line a run."""
    figure = Figure(figsize=(11, 6), dpi=100, layout="constrained")
    axes = dict(zip(PANELS, figure.subplots(2, 2).flat, strict=True))
    for run in all_runs(outputs):
        precision, seed = run.config["training"]["precision"], run.config["seed"]
        commit = read_commit(run.path)
        assert commit is not None
        curves: dict[str, list[tuple[int, float]]] = defaultdict(list)
        for _, record in read(run.path, 0, commit.offset):
            if isinstance(record, Metrics):
                for key in PANELS.keys() & record.values.keys():
                    curves[key].append((record.step, record.values[key]))
        for key, points in curves.items():
            axes[key].plot(
                *zip(*points, strict=True), color=COLOURS[precision], alpha=0.8, linewidth=1, label=precision
            )
        if run.result is not None:
            print(f"{precision} seed {seed}: mean {run.result.evaluation['evaluation/mean']:,.0f}")
    for key, title in PANELS.items():
        handles = dict(zip(*reversed(axes[key].get_legend_handles_labels()), strict=True))
        axes[key].legend(handles.values(), handles.keys())
        axes[key].set(title=title, xlabel="steps")
    figure.savefig("docs/images/precision.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
