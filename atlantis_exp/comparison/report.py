"""Comparison to page: one HTML file that needs nothing else, and its tables as CSV."""

from collections.abc import Mapping
from importlib.resources import files

from jinja2 import Environment, StrictUndefined

from atlantis_exp.comparison.figures import Drawn
from atlantis_exp.comparison.tables import Comparison, Row, Table


def page(comparison: Comparison, figures: Mapping[str, Drawn], facts: Mapping[str, str]) -> str:
    """The HTML page of a comparison; `facts` say how and when it was made. Whatever comes from data is escaped."""
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined)
    template = environment.from_string((files("atlantis_exp.comparison") / "page.html").read_text("utf-8"))
    return template.render(
        comparison=comparison, tables=comparison.tables, figures=figures, facts=facts, columns=COLUMNS, cells=cells
    )


_SCORES = {"episodes": "episodes", "iqm": "IQM", "mean": "mean", "median": "median", "low": "low", "high": "high"}

COLUMNS = {
    "evaluation": {
        "group": "group",
        "runs": "runs",
        **_SCORES,
        "score_per_1000_steps": "score / 1,000 steps",
        "time_cap_share": "at time cap",
        "human_normalised_mean": "human-normalised",
    },
    "verdict": {
        "view": "view",
        "at": "up to",
        "leader": "leader",
        "leader_score": "its score",
        "other": "other",
        "other_score": "its score",
        "difference": "difference",
        "decided": "decided",
        "more_seeds": "more seeds",
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
        **_SCORES,
    },
    "actions": {"group": "group", "action": "action", "network": "network", "random": "chance"},
    "references": {"name": "player", "score": "score", "protocol": "protocol", "source": "source"},
    "skipped": {"run": "run", "reason": "why it is left out"},
}
"""The tables that the page shows: their columns and how a person calls them."""

_SHARES = {"time_cap_share", "probability", "network", "random", "human_normalised_mean"}


def cells(name: str, row: Row) -> list[tuple[str, bool]]:
    """A row of a shown table as texts, intervals included, and whether each is a number."""
    texts = []
    for column in COLUMNS[name]:
        value = row[column]
        text = number(value, column)
        low, high = {
            "probability": ("low", "high"),
            "difference": ("low", "high"),
        }.get(column, (f"{column}_low", f"{column}_high"))
        if low in row and row[low] == row[low]:
            text += f" ({number(row[low], column)} to {number(row[high], column)})"
        texts.append((text, isinstance(value, int | float) and not isinstance(value, bool)))
    return texts


def number(value: object, column: str = "") -> str:
    """A table's value as a person reads it."""
    if value is None:
        return "over 1,000"  # of seeds
    if isinstance(value, bool):
        return "yes" if value else "no"
    if not isinstance(value, int | float):
        return str(value)
    if column in _SHARES:
        return f"{value:.1%}"
    if column in ("seed", "epsilon"):
        return str(value)
    if abs(value) >= 1e9:
        return f"{value:.3g}"
    return f"{value:,.0f}" if abs(value) >= 10 or value == int(value) else f"{value:.3g}"


def plain(name: str, table: Table) -> list[list[str]]:
    """A shown table as texts, header first."""
    return [list(COLUMNS[name].values()), *([text for text, _ in cells(name, row)] for row in table)]
