"""Read and write the table of evaluated episodes, one row each."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt

from atlantis_exp.runs.files import SMALL, read_file

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class EpisodeTable:
    """Columns of evaluated episodes."""

    actions: tuple[str, ...]
    seeds: npt.NDArray[np.int64]  # (episodes,), of the emulators
    scores: Array  # (episodes,)
    steps: Array  # (episodes,)
    frames: Array  # (episodes,)
    truncated: Array  # (episodes,), 1 where the time cap ended it
    counts: Array  # steps, (episodes, actions, 2): chosen by the network, by chance
    points: Array  # (episodes, sources), the scores' parts; NaN if an older version did not record them
    sources: tuple[str, ...]  # of points

    def to_csv(self) -> str:
        """Return the table with a header: steps by action, the random ones, and points by source."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        by_chance = [f"{action}_random" for action in self.actions]
        head = ("episode", "seed", "score", "steps", "frames", "truncated", "random", *self.actions, *by_chance)
        writer.writerow((*head, *self.sources))
        for index, counts in enumerate(self.counts.astype(np.int64)):
            ends = (int(column[index]) for column in (self.steps, self.frames, self.truncated))
            row = (index, int(self.seeds[index]), float(self.scores[index]), *ends, int(counts[:, 1].sum()))
            writer.writerow((*row, *counts.sum(1).tolist(), *counts[:, 1].tolist(), *self.points[index].tolist()))
        return text.getvalue()

    @classmethod
    def read(cls, path: Path, sources: Sequence[str] = ()) -> Self:
        """Read a table with the points of these sources. Raises: ValueError, OSError."""
        try:
            header, *lines = csv.reader(io.StringIO(read_file(path, SMALL).decode(), newline=""), strict=True)
            rows = [dict(zip(header, line, strict=True)) for line in lines]
            return cls._of(rows, sources)
        except (ValueError, KeyError, csv.Error) as error:
            raise ValueError(f"{path} is not a table of episodes: {error}") from None

    @classmethod
    def _of(cls, rows: Sequence[Mapping[str, str]], sources: Sequence[str]) -> Self:
        if not rows:
            raise ValueError("it has none")
        actions = tuple(name.removesuffix("_random") for name in rows[0] if name.endswith("_random"))
        if not actions:
            raise ValueError("it does not say who chose the actions: evaluate again")
        chance = np.array([[float(row[f"{action}_random"]) for action in actions] for row in rows])
        both = np.array([[float(row[action]) for action in actions] for row in rows])
        scores, steps, frames, truncated = (
            np.array([float(row[name]) for row in rows]) for name in ("score", "steps", "frames", "truncated")
        )
        seeds = np.array([int(row["seed"]) for row in rows])
        points = np.array([[float(row.get(source, "nan")) for source in sources] for row in rows])
        counts = np.stack((both - chance, chance), axis=2)
        for numbers in (scores, steps, frames, truncated, counts, np.nan_to_num(points)):
            if not np.all(np.abs(numbers) <= 1e15):  # so that a mean of squares does not overflow
                raise ValueError("it has numbers beyond 1e15")
        return cls(actions, seeds, scores, steps, frames, truncated, counts, points, tuple(sources))
