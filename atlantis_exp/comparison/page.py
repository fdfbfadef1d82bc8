"""Write a comparison as a page: one HTML file that needs no other; and say how its tables are shown."""

from collections.abc import Mapping, Sequence
from importlib.resources import files

from jinja2 import Environment, StrictUndefined

from atlantis_exp.comparison.figures import Drawn
from atlantis_exp.comparison.published import Row, Table
from atlantis_exp.comparison.tables import Comparison


def page(comparison: Comparison, figures: Mapping[str, Drawn], facts: Mapping[str, str]) -> str:
    """Return the HTML page; `facts` say how and when it was made. Everything from data is escaped."""
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined)
    template = environment.from_string((files("atlantis_exp.comparison") / "page.html").read_text("utf-8"))
    return template.render(
        comparison=comparison,
        tables=comparison.tables,
        figures=figures,
        facts=facts,
        shown_columns=shown_columns,
        label=label,
        cells=cells,
        explained=EXPLAINED,
    )


_EPISODES = {"episodes": "episodes", "mean": "mean", "median": "median", "low": "low", "high": "high"}
_DIFFERENCE = {"difference": "difference", "said": "verdict"}

COLUMNS = {
    "scores": {"family": "by", "group": "group", "seeds": "seeds", "score": "mean of IQMs", **_DIFFERENCE},
    "verdict": {"family": "by", "group": "group", "other": "against", **_DIFFERENCE, "seeds": "seeds each"},
    "plan": {
        "family": "by",
        "planned": "looks planned at",
        "taken": "taken at",
        "next_look": "next look at",
        "spent": "error spent",
        "error": "of",
    },
    "looks": {
        "family": "by",
        "look": "look",
        "seeds": "seeds each",
        "spent": "error spent",
        "group": "group",
        "other": "against",
        **_DIFFERENCE,
    },
    "evaluation": {
        "group": "group",
        "runs": "runs",
        **_EPISODES,
        "points_per_frame": "points per frame",
        "time_cap_share": "at time cap",
        "human_normalised_mean": "human-normalised",
    },
    "why": {
        "group": "group",
        "mean": "mean score",
        "frames_mean": "frames an episode",
        "time_cap_share": "at time cap",
        "points_per_1000_frames": "points per 1,000 frames",
    },
    "modes": {
        "group": "group",
        "seeds": "seeds",
        "upper_share": "in the upper mode",
        "upper_score": "score of those",
        "lower_score": "of the others",
        "time_cap_share": "episodes at time cap",
        "points_per_frame": "points per frame",
    },
    "views": {
        "view": "view",
        "at": "up to",
        "leader": "leader",
        "leader_score": "its score",
        "other": "other",
        "other_score": "its score",
        "difference": "difference",
    },
    "improvement": {"group": "group", "over": "over", "probability": "probability of improvement"},
    "runs": {
        "run": "run",
        "group": "group",
        "seed": "seed",
        "frames": "frames",
        "hours": "hours",
        "flops": "FLOPs",
        "epsilon": "epsilon",
        "score": "IQM",
        **_EPISODES,
        "policy": "policy",
        "same_as": "plays as",
    },
    "actions": {"group": "group", "action": "action", "network": "network", "random": "chance"},
    "references": {
        "name": "player",
        "score": "mean score",
        "points_per_frame": "points per frame",
        "protocol": "protocol",
        "source": "source",
    },
    "skipped": {"run": "run", "reason": "why it is left out"},
}
"""The tables that the page shows: each column and its title."""

EXPLAINED = {
    "by": "the key whose values are compared, averaged over the others",
    "IQM": "the interquartile mean of a seed's evaluated episodes: the seed's score",
    "mean of IQMs": "a group's score: the mean over its seeds of the interquartile means of their episodes",
    "seeds each": "seeds of each of the two groups that the verdict rests on",
    "verdict": "better, worse, equivalent within delta, or not decided",
    "look": "a planned glance at the seeds so far, which spends a share of the error",
    "error spent": "the share of the allowed probability of a false verdict that the looks have used up",
    "of": "the allowed probability of any false verdict, over all pairs and looks",
    "points per frame": "all points of the episodes over all their emulator frames, which no time cap distorts",
    "points per 1,000 frames": "1,000 times all points of the episodes over all their emulator frames",
    "at time cap": "the share of episodes that the limit of frames or steps ended",
    "episodes at time cap": "the share of episodes that the limit of frames or steps ended",
    "human-normalised": "0 % is the published random player, 100 % the published human",
    "probability of improvement": "of an episode of the group and one of the other, how often the first scores higher",
    "in the upper mode": "the share of seeds that survive where seeds fall into two modes",
    "FLOPs": "floating-point operations of all gradient updates",
    "epsilon": "the share of actions left to chance in evaluation",
    "policy": "the action that the network chose most in evaluation; collapsed: it chose one only",
    "plays as": "a run with the same score in every episode",
    "chance": "the share of steps whose action was drawn at random",
}
"""A sentence on a title."""

SHARES = {
    *("time_cap_share", "truncated_share", "random_share", "upper_share", "share", "probability", "network", "random"),
    *("human_normalised_mean", "error", "spent"),
}
"""The columns that are shares and probabilities, from 0 to 1."""
_ENDS = {
    ("scores", "score"): ("low", "high"),
    ("scores", "difference"): ("difference_low", "difference_high"),
    **{(table, "difference"): ("low", "high") for table in ("verdict", "looks", "views")},
}
"""The columns of a table that have an interval, and those of its ends."""


def label(name: str, column: str) -> str:
    """Return the title of a column."""
    return COLUMNS.get(name, {}).get(column, column.replace("_", " "))


def shown_columns(name: str, table: Table) -> list[str]:
    """Return the columns that are shown: no differences without a baseline, no family if there is one.

    `why` has further ones: the sources of points in the game. A table that is not the page's has all but the ends of
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
    """Return a row's columns as texts with intervals, and whether each is a number."""
    texts = []
    for column in columns:
        text, ends = number(row.get(column), column), _ENDS.get((name, column), (f"{column}_low", f"{column}_high"))
        low, high = (number(row.get(end), column) for end in ends)
        is_number = bool(text) and isinstance(row[column], int | float) and not isinstance(row[column], bool)
        texts.append((f"{text} ({low} to {high})" if low else text, is_number))
    return texts


def number(value: object, column: str = "") -> str:
    """Return a table's value as a person reads it."""
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
    return f"{value:,.0f}" if abs(value) >= 10 or value == int(value) else f"{value:.3g}"


def plain(name: str, table: Table) -> list[list[str]]:
    """Return a shown table as texts, header first."""
    columns = shown_columns(name, table)
    header = [label(name, column) for column in columns]
    return [header, *([text for text, _ in cells(name, row, columns)] for row in table)]
