"""What others have scored: the tables that ship with the package, with their protocols and sources."""

import csv
import io
from importlib.resources import files
from typing import Any

from atlantis_exp.statistics import RANDOM_SCORE

Row = dict[str, Any]
Table = list[Row]


def literature(name: str) -> Table:
    """The published `scores` (players and algorithms) or learning `curves` that ship with the package, with sources."""
    text = (files("atlantis_exp.comparison") / f"published_{name}.csv").read_text("utf-8")
    table: Table = list(csv.DictReader(io.StringIO(text)))
    for row in table:
        for key in {"score", "mean", "low", "high", "seeds"} & row.keys():
            row[key] = float(row[key])
        if "frames_millions" in row:
            row["frames"] = 1e6 * float(row.pop("frames_millions"))
    return table


def random_line(references: Table) -> Row:
    """The random player measured under the runs' own settings, else the published one."""
    return next(row for row in references if row["name"].startswith("random"))


def early_dqn() -> str:
    """Why below random is no bug, from the published learning curves."""
    at = [row for row in literature("curves") if row["name"].startswith("DQN") and row["frames"] == 5e6]
    low, high = min(row["mean"] for row in at), max(row["mean"] for row in at)
    return (
        f"At 5 M frames published DQN scores {low:,.0f} to {high:,.0f}, below the random player's "
        f"{RANDOM_SCORE:,.0f}: below random is normal here ({at[0]['source'].rpartition('/')[0]})."
    )
