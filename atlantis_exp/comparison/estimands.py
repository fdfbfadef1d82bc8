"""Estimate the score of a training over its last steps from the table of its episodes."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt

from atlantis_exp.comparison.gather import Training
from atlantis_exp.faults import ConfigError
from atlantis_exp.runs.files import SMALL, read_file
from atlantis_exp.runs.folder import EPISODES, RunFolder

Array = npt.NDArray[np.float64]

WINDOW = 0.2  # of the steps, at the end: "the last training episodes" of Machado et al. 2018
FEWEST_EPISODES = 30  # that must end in the window
_EQUAL = 0.01  # largest difference in epsilon between comparable trainings


@dataclass(frozen=True)
class TrainingEpisodes:
    """The episodes that ended during a training, one row each."""

    ends: Array  # (episodes,), steps of the training, of all environments together
    lengths: Array  # (episodes,), steps of the episode's own environment
    scores: Array  # (episodes,)

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read `episodes.csv`. Raises: ValueError, OSError."""
        try:
            rows = list(csv.DictReader(io.StringIO(read_file(path, SMALL).decode(), newline=""), strict=True))
            columns = [np.array([float(row[name]) for row in rows]) for name in ("step", "length", "score")]
            if not all((np.abs(column) <= 1e15).all() for column in columns) or (columns[1] < 1).any():
                raise ValueError("it has numbers beyond 1e15 or episodes without a step")
        except (ValueError, TypeError, KeyError, csv.Error) as error:
            raise ValueError(f"{path} is not a table of a training's episodes: {error}") from None
        return cls(*columns)


def training_score(episodes: TrainingEpisodes, steps: int, num_envs: int, window: float = WINDOW) -> float:
    """Return the mean score of an episode in the last share of a training: points there, divided by episodes ended.

    Renewal theory gives this ratio for the mean (Smith 1958). The mean over the episodes that ended in the window is
    too low while a network learns, since they began with an earlier one. An episode that began before the window counts
    with its steps inside; open episodes count with the points per step of the others.

    steps: of the whole training, over all environments.

    Raises: ValueError if fewer than `FEWEST_EPISODES` episodes ended in the window.
    """
    start = steps * (1 - window)
    ended = episodes.ends > start
    if (count := int(ended.sum())) < FEWEST_EPISODES:
        raise ValueError(
            f"{count} episodes ended in the last {100 * window:g}% of {steps:,} steps, and a training score needs "
            f"{FEWEST_EPISODES}: take a wider window, or the score of an evaluation"
        )
    lengths = episodes.lengths[ended]
    within = np.minimum(lengths, (episodes.ends[ended] - start) / num_envs)
    points_a_step = (episodes.scores[ended] * within / lengths).sum() / within.sum()
    return float(points_a_step * (steps - start) / count)


def score_of(folder: RunFolder, window: float = WINDOW) -> float:
    """Return the training score of a finished run. Raises: ValueError, OSError, Fault."""
    result, num_envs = folder.result, folder.trained_config.env.num_envs
    if result is None:
        raise ValueError("unfinished")
    return training_score(TrainingEpisodes.read(folder.artifact(EPISODES)), result.steps, num_envs, window)


def by_training(trainings: Sequence[Training], outputs: Path, window: float) -> list[Training]:
    """Return trainings that count by their training scores.

    None is left out, since those with games too long to estimate may be the best.

    Raises: ConfigError for a training without such a score, or if epsilon differs in the window.
    """
    explored = {training.name: _epsilon(training, window) for training in trainings}
    least, most = min(explored, key=explored.__getitem__), max(explored, key=explored.__getitem__)
    if not explored[most] - explored[least] <= _EQUAL:
        raise ConfigError(
            f"score=training: epsilon differs in the last {100 * window:g}% of the steps, so the scores do not mean "
            f"the same: {explored[least]:.3g} in {least}; {explored[most]:.3g} in {most}; "
            "score=last compares the networks"
        )
    scored = []
    for training in trainings:
        try:
            score = score_of(RunFolder(outputs / "runs" / training.name), window)
        except (ValueError, OSError) as error:
            raise ConfigError(f"score=training: {training.name}: {error}") from None
        scored.append(replace(training, training_score=score))
    return scored


def _epsilon(training: Training, window: float) -> float:
    """Return the mean epsilon in the last share of a training."""
    if not training.curve:
        raise ConfigError(f"score=training: {training.name} has no curve, so its epsilon is unknown")
    frames = training.curve["frames"]
    return float(np.interp(np.linspace(1 - window, 1, 101) * frames[-1], frames, training.curve["epsilon"]).mean())
