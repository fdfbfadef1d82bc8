"""Read the published scores and curves that come with a game, with protocols and sources."""

import csv
import io
from collections.abc import Sequence
from math import isnan, nan
from typing import Any

from atlantis_exp.components import Component, facts_of
from atlantis_exp.faults import ConfigError
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
    for row in _read(game, "scores.csv", ("name", "kind", "protocol", "source"), ("score", "capped_frames")):
        frames = row.pop("capped_frames") or nan
        table.append({**row, "points_per_frame": row["score"] / frames})
    return table


def curves(game: Component | None) -> Table:
    """Return the published learning curves, if any."""
    numbers = ("frames_millions", "seeds", "mean", "low", "high")
    return [
        {**row, "frames": 1e6 * row.pop("frames_millions")}
        for row in _read(game, "curves.csv", ("name", "source"), numbers)
    ]


def _read(game: Component | None, name: str, texts: Sequence[str], numbers: Sequence[str]) -> Table:
    """Read columns of a game's table; empty `capped_frames` are NaN. Raises: ConfigError."""
    if game is None or not (path := game.data_path(name)).is_file():
        return []
    table = Table()
    try:
        for row in csv.DictReader(io.StringIO(read_file(path.resolve(), SMALL).decode("utf-8-sig"))):
            read = {key: float(row[key] or (nan if key == "capped_frames" else "")) for key in numbers}
            table.append({**{key: row[key] or "" for key in texts}, **read})
    except (KeyError, ValueError, csv.Error) as error:
        reason = f"no column {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
        raise ConfigError(f"{path}, row {len(table) + 1}: {reason}") from None
    return table


def random_line(references: Table) -> Row | None:
    """Return the random player measured under the runs' settings, or else the published one, if any."""
    return next((row for row in references if row["name"].startswith("random")), None)
