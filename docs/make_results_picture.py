"""Draw `docs/images/fast.png`: training and evaluation scores of docs/results.md by steps and by hours.

`python docs/make_results_picture.py OUTPUTS...`, from the root of the checkout, where each OUTPUTS is a folder that the
trainings of docs/results.md wrote. Prints where each run stands at every 100,000 steps.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from atlantis_exp.commands.runs import RunFolder, all_runs
from atlantis_exp.media import BLUE, GREEN, GREY, PURPLE, VERMILLION
from atlantis_exp.tracking.journal import Metrics, read, read_commit

KEYS = ("score/mean_20", "score/mean_100", "learning/updates", "throughput/frames", "throughput/hours")
RANDOM = 20_873  # a random player's mean (docs/reproduction.md)


def main(outputs: Sequence[Path]) -> None:
    """Read the journals and draw a line a run, with a point for each evaluation."""
    figure = Figure(figsize=(11, 4.5), dpi=100, layout="constrained")
    by_steps, by_hours = figure.subplots(1, 2, sharey=True)
    runs = [run for folder in outputs for run in all_runs(folder)]
    for colour, run in zip((VERMILLION, BLUE, GREEN, PURPLE), runs, strict=False):
        config = run.config
        label = (
            f"{config['model']['name']}, n_step={config['objective']['n_step']}, "
            f"epsilon {config['epsilon']['end']:g}, learn_every={config['training']['learn_every']}"
        )
        print(f"{run.name}: {label}")
        curve, evaluated = curves_of(run)
        steps, scores, *_, hours = curve
        for row in np.searchsorted(steps, np.arange(1e5, steps[-1], 1e5)):
            print(*(f"{column[row]:12,.2f}" for column in curve))
        for axes, x in ((by_steps, steps / 1e6), (by_hours, hours)):
            axes.plot(x, scores, color=colour, label=label, linewidth=1)
            axes.plot(np.interp(evaluated[0], steps, x), evaluated[1], "o", color=colour)
    for axes in (by_steps, by_hours):
        axes.axhline(RANDOM, color=GREY, linestyle=":", linewidth=1)
    by_steps.set(yscale="log", xlabel="million steps", ylabel="score: mean of 20 in training, evaluations as points")
    by_steps.legend(frameon=False, fontsize="small")
    by_hours.set(xlabel="hours, whatever else the machine did")
    figure.savefig("docs/images/fast.png")


def curves_of(run: RunFolder) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Steps and, at each, the KEYS, as far as the run is committed; steps and means of its evaluations."""
    commit = read_commit(run.path)
    assert commit is not None
    latest: dict[str, float] = {}
    rows, evaluations = [], []
    for _, record in read(run.path, 0, commit.offset):
        if isinstance(record, Metrics):
            latest |= record.values
            if KEYS[0] in record.values and all(key in latest for key in KEYS):
                rows.append([record.step, *(latest[key] for key in KEYS)])
            if "evaluation/mean" in record.values:
                evaluations.append([record.step, record.values["evaluation/mean"]])
    return list(np.array(rows).T), list(np.array(evaluations).reshape(-1, 2).T)


if __name__ == "__main__":
    main([Path(argument) for argument in sys.argv[1:]])
