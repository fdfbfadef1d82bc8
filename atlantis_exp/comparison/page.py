"""Write a comparison as a self-contained HTML page, and define how its tables are shown."""

from collections.abc import Mapping, Sequence
from functools import partial
from importlib.resources import files

from jinja2 import Environment, StrictUndefined

from atlantis_exp.comparison.figures import Drawn
from atlantis_exp.comparison.published import Row, Table
from atlantis_exp.comparison.tables import Comparison
from atlantis_exp.comparison.words import points


def page(comparison: Comparison, figures: Mapping[str, Drawn], facts: Mapping[str, str]) -> str:
    """Return the HTML page, with all data escaped; `facts` say how and when it was made."""
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined)
    template = environment.from_string((files("atlantis_exp.comparison") / "page.html").read_text("utf-8"))
    return template.render(
        comparison=comparison,
        tables=comparison.tables,
        figures=figures,
        facts=facts,
        shown_columns=shown_columns,
        label=partial(label, score=comparison.question.score),
        cells=cells,
    )


COLUMNS: Mapping[str, Sequence[str]] = {
    "scores": ("family", "group", "seeds", "score", "difference", "said"),
    "verdict": ("family", "group", "other", "difference", "said", "seeds"),
    "plan": ("family", "planned", "taken", "next_look", "spent", "error"),
    "looks": ("family", "look", "seeds", "spent", "group", "other", "difference", "said"),
    "evaluation": (
        *("group", "runs", "episodes", "mean", "median", "low", "high"),
        *("points_per_frame", "time_cap_share", "human_normalised_mean"),
    ),
    "why": ("group", "mean", "frames_mean", "time_cap_share", "points_per_1000_frames"),
    "views": ("view", "at", "leader", "leader_score", "other", "other_score", "difference"),
    "runs": (
        *("run", "group", "seed", "frames", "hours", "flops", "epsilon", "score"),
        *("episodes", "mean", "median", "low", "high", "policy", "same_as"),
    ),
    "actions": ("group", "action", "network", "random"),
    "references": ("name", "score", "points_per_frame", "protocol", "source"),
    "skipped": ("run", "reason"),
}
"""The tables that the page shows, and their columns."""

_TITLES = {
    ("references", "score"): "mean score",
    ("why", "mean"): "mean score",
    ("views", "other"): "other",
    **{(table, "seeds"): "seeds each" for table in ("verdict", "looks")},
}
_SCORE = {"last": "IQM", "training": "training score"}  # of a seed, by the question's score
_TITLE = {
    "family": "by",
    "other": "against",
    "said": "verdict",
    "planned": "looks planned at",
    "taken": "taken at",
    "next_look": "next look at",
    "spent": "error spent",
    "error": "of",
    "time_cap_share": "at time cap",
    "human_normalised_mean": "human-normalised",
    "frames_mean": "frames an episode",
    "points_per_1000_frames": "points per 1,000 frames",
    "at": "up to",
    "leader_score": "its score",
    "other_score": "its score",
    "flops": "FLOPs",
    "same_as": "plays as",
    "random": "chance",
    "name": "player",
    "reason": "why it is left out",
}
"""The titles of columns, in one table or in all, that differ from their names."""

SHARES = {
    *("time_cap_share", "truncated_share", "random_share", "share", "network", "random"),
    *("human_normalised_mean", "error", "spent"),
}
"""The columns with shares, from 0 to 1."""
_ENDS = {
    ("scores", "score"): ("low", "high"),
    ("scores", "difference"): ("difference_low", "difference_high"),
    **{(table, "difference"): ("low", "high") for table in ("verdict", "looks", "views")},
}
"""The columns with an interval, and the columns of its ends."""


def label(name: str, column: str, score: str = "") -> str:
    """Return the title of a column; `score` is the question's."""
    if column == "score" and name in ("scores", "runs"):
        return _SCORE.get(score, column)
    return (
        _TITLES.get((name, column)) or _TITLE.get(column, column.replace("_", " "))
        if name in COLUMNS
        else column.replace("_", " ")
    )


def shown_columns(name: str, table: Table) -> list[str]:
    """Return the columns to show: differences only with a baseline, the family only if there are several.

    `why` also shows the game's sources of points. A table that is not on the page shows all columns except the ends of
    intervals, which are written with their values.
    """
    keys = [*dict.fromkeys(key for row in table for key in row)]
    if name not in COLUMNS:
        return [key for key in keys if not any(key in (f"{other}_low", f"{other}_high") for other in keys)]
    hidden = {"family"} if len({row.get("family") for row in table}) == 1 else set()
    if name == "scores" and not any(row["baseline"] for row in table):
        hidden |= {"difference", "said"}
    further = [key for key in keys if key not in COLUMNS[name]] if name == "why" else []
    return [key for key in (*COLUMNS[name], *further) if key in keys and key not in hidden]


def cells(name: str, row: Row, columns: Sequence[str]) -> list[tuple[str, bool]]:
    """Return a row's cells as texts with intervals, and whether each is a number."""
    texts = []
    for column in columns:
        text, ends = number(row.get(column), column), _ENDS.get((name, column), (f"{column}_low", f"{column}_high"))
        low, high = (number(row.get(end), column) for end in ends)
        is_number = bool(text) and isinstance(row[column], int | float) and not isinstance(row[column], bool)
        texts.append((f"{text} ({low} to {high})" if low else text, is_number))
    return texts


def number(value: object, column: str = "") -> str:
    """Format a table's value for people."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None or value != value:
        return ""
    if not isinstance(value, int | float):
        return str(value)
    if column in ("error", "spent"):
        return f"{value:.2%}"
    if column in SHARES:
        return f"{value:.1%}"
    if column in ("seed", "epsilon"):
        return str(value)
    if abs(value) >= 1e9:
        return f"{value:.3g}"
    return points(value)


def plain(name: str, table: Table, score: str = "") -> list[list[str]]:
    """Return a shown table as texts, header first; score: as in `label`."""
    columns = shown_columns(name, table)
    header = [label(name, column, score) for column in columns]
    return [header, *([text for text, _ in cells(name, row, columns)] for row in table)]
