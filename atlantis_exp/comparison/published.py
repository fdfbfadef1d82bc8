"""Read the published scores and curves that come with a game, with protocols and sources."""

import csv
import io
from math import isnan, nan
from typing import Any

from atlantis_exp.components import Component, facts_of
from atlantis_exp.runs.files import SMALL, read_file

Row = dict[str, Any]
Table = list[Row]


def scores(game: Component | None) -> Table:
    """Return the published scores of players and algorithms, if any.

    Points per frame assume that episodes reach the time cap, so they are lower bounds.
    """
    facts = facts_of(game)
    of = {"points_per_frame": nan, "kind": "player", "protocol": "published, no-op starts"}
    of["source"] = "dqn_zoo/atari_data.py (Quan and Ostrovski 2020)"
    players = {"random player": facts.random_score, "human": facts.human_score}
    table = [{"name": name, "score": score, **of} for name, score in players.items() if not isnan(score)]
    for row in _read(game, "scores.csv"):
        frames = float(row.pop("capped_frames", "") or nan)
        table.append({**row, "points_per_frame": row["score"] / frames})
    return table


def curves(game: Component | None) -> Table:
    """Return the published learning curves, if any."""
    return [{**row, "frames": 1e6 * float(row.pop("frames_millions"))} for row in _read(game, "curves.csv")]


def _read(game: Component | None, name: str) -> Table:
    if game is None or not (path := game.data_path(name)).is_file():
        return []
    table: Table = list(csv.DictReader(io.StringIO(read_file(path.resolve(), SMALL).decode())))
    for row in table:
        for key in {"score", "mean", "low", "high", "seeds"} & row.keys():
            row[key] = float(row[key])
    return table


def random_line(references: Table) -> Row | None:
    """Return the random player measured under the runs' settings, or else the published one, if any."""
    return next((row for row in references if row["name"].startswith("random")), None)
