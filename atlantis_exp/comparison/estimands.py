"""Estimate how a training played over its last steps, from the table of its episodes."""

import csv
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt

from atlantis_exp.runs.files import SMALL, read_file

Array = npt.NDArray[np.float64]

WINDOW = 0.2  # of the steps, the last ones: "the last training episodes" of Machado et al. 2018
FEWEST_EPISODES = 30  # that must end in the window


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
        except (ValueError, TypeError, KeyError, csv.Error) as error:
            raise ValueError(f"{path} is no table of a training's episodes: {error}") from None
        return cls(*columns)


def training_score(episodes: TrainingEpisodes, steps: int, num_envs: int, window: float = WINDOW) -> float:
    """Return the mean score of an episode in the last share of a training: its points there over its episodes' ends.

    The ratio is what renewal theory gives for the mean (Smith 1958). The mean over the episodes that ended in the
    window is too low while a network learns, since an episode that ends has begun with an earlier one. An episode that
    began before the window counts with the points of its steps within it; episodes that are not over at its end have
    the points a step of the others.

    Args:
        steps: of the whole training, of all environments together.

    Raises:
        ValueError: where fewer than `FEWEST_EPISODES` episodes ended in the window.
    """
    start = steps * (1 - window)
    ended = episodes.ends > start
    if (count := int(ended.sum())) < FEWEST_EPISODES:
        raise ValueError(
            f"{count} episodes ended in the last {window:.0%} of {steps:,} steps, and a training score needs "
            f"{FEWEST_EPISODES}: take a wider window, or the score of an evaluation"
        )
    lengths = episodes.lengths[ended]
    within = np.minimum(lengths, (episodes.ends[ended] - start) / num_envs)
    points_a_step = (episodes.scores[ended] * within / lengths).sum() / within.sum()
    return float(points_a_step * (steps - start) / count)
