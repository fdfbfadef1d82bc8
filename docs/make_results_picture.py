"""Draw `docs/images/fast.png`: training scores of docs/results.md by steps and by samples learned from.

`python docs/make_results_picture.py OUTPUTS...`, from the root of the checkout, where each OUTPUTS is a folder that the
trainings of docs/results.md wrote. Prints where each run stands at every 100,000 steps.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from atlantis_exp.commands.runs import RunFolder, all_runs
from atlantis_exp.media import BLUE, VERMILLION
from atlantis_exp.tracking.journal import Metrics, read, read_commit

KEYS = ("score/mean_100", "learning/updates", "throughput/frames", "throughput/hours")


def main(outputs: Sequence[Path]) -> None:
    """Read the journals and draw a line a run."""
    figure = Figure(figsize=(11, 4), dpi=100, layout="constrained")
    by_steps, by_samples = figure.subplots(1, 2, sharey=True)
    for colour, run in zip((BLUE, VERMILLION), (run for folder in outputs for run in all_runs(folder)), strict=False):
        training = run.config["training"]
        label = f"learn_every={training['learn_every']}, lr={run.config['optimizer']['lr']:g}"
        print(label)
        steps, scores, updates, *_ = curve = curve_of(run)
        for row in np.searchsorted(steps, np.arange(1e5, steps[-1], 1e5)):
            print(*(f"{column[row]:12,.2f}" for column in curve))
        by_steps.plot(steps / 1e6, scores, color=colour, label=label)
        by_samples.plot(updates * training["batch_size"] / 1e6, scores, color=colour, label=label)
    by_steps.set(xlabel="million steps", ylabel="score in training, mean of 100 episodes")
    by_samples.set(xlabel="million samples learned from")
    by_steps.legend(frameon=False)
    figure.savefig("docs/images/fast.png")


def curve_of(run: RunFolder) -> list[np.ndarray]:
    """Steps and, at each, the KEYS, as far as the run is committed."""
    commit = read_commit(run.path)
    assert commit is not None
    latest: dict[str, float] = {}
    rows = []
    for _, record in read(run.path, 0, commit.offset):
        if isinstance(record, Metrics):
            latest |= record.values
            if KEYS[0] in record.values and all(key in latest for key in KEYS):
                rows.append([record.step, *(latest[key] for key in KEYS)])
    return list(np.array(rows).T)


if __name__ == "__main__":
    main([Path(argument) for argument in sys.argv[1:]])
