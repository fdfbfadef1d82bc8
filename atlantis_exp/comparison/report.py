"""Comparison to page: one HTML file that needs nothing else, and its tables as CSV."""

from collections.abc import Mapping
from importlib.resources import files

from jinja2 import Environment, StrictUndefined

from atlantis_exp.comparison.figures import Drawn
from atlantis_exp.comparison.published import Row, Table
from atlantis_exp.comparison.tables import Comparison


def page(comparison: Comparison, figures: Mapping[str, Drawn], facts: Mapping[str, str]) -> str:
    """The HTML page of a comparison; `facts` say how and when it was made. Whatever comes from data is escaped."""
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined)
    template = environment.from_string((files("atlantis_exp.comparison") / "page.html").read_text("utf-8"))
    return template.render(
        comparison=comparison,
        tables=comparison.tables,
        figures=figures,
        facts=facts,
        titles=titles,
        cells=cells,
        explained=EXPLAINED,
    )


_EPISODES = {"episodes": "episodes", "mean": "mean", "median": "median", "low": "low", "high": "high"}
_DIFFERENCE = {"difference": "difference", "said": "verdict"}

COLUMNS = {
    "scores": {"family": "by", "group": "group", "seeds": "seeds", "score": "score", **_DIFFERENCE},
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
        "score": "score",
        **_EPISODES,
        "policy": "policy",
        "same_as": "plays as",
    },
    "actions": {"group": "group", "action": "action", "network": "network", "random": "chance"},
    "probes": {
        "group": "group",
        "run": "its run",
        "other": "against",
        "other_run": "its run",
        "states": "states",
        "equal_actions": "equal actions",
        "equal_by_chance": "by chance",
        "equal_where_clear": "where both are clear",
        "advantage_distance": "distance of advantages",
        "state_value_correlation": "rank correlation of state values",
    },
    "partings": {
        "group": "group",
        "other": "against",
        "seed": "seed of the game",
        "outcome": "outcome",
        "step": "at step",
        "frame": "frame",
        "score": "score so far",
        "action": "group chose",
        "other_action": "other chose",
        "values": "group's values",
        "other_values": "other's values",
        "later_score": "group's score at the film's end",
        "other_later_score": "other's",
    },
    "references": {
        "name": "player",
        "score": "mean score",
        "points_per_frame": "points per frame",
        "protocol": "protocol",
        "source": "source",
    },
    "skipped": {"run": "run", "reason": "why it is left out"},
}
"""The tables that the page shows: their columns and how a person calls them."""

EXPLAINED = {
    "by": "the key whose values are compared, averaged over the others",
    "score": "of a seed: the interquartile mean of its evaluated episodes; of a group: the mean over its seeds",
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
    "by chance": "the share of equal actions if both chose independently, each as often as it does",
    "distance of advantages": "the mean difference of normalised action values: 0 if equal, about 1.1 if unrelated",
    "rank correlation of state values": "Spearman's, of the highest action values over the states",
}
"""What a header's term means, in a sentence."""

SHARES = {
    *("time_cap_share", "truncated_share", "random_share", "upper_share", "share", "probability", "network", "random"),
    *("human_normalised_mean", "error", "spent", "equal_actions", "equal_by_chance", "equal_where_clear"),
}
"""The columns that are shares and probabilities, from 0 to 1."""
_ENDS = {
    ("scores", "score"): ("low", "high"),
    ("scores", "difference"): ("difference_low", "difference_high"),
    **{(table, "difference"): ("low", "high") for table in ("verdict", "looks", "views")},
}
"""The columns of a table that have an interval, and those of its ends."""


def titles(name: str, table: Table) -> list[str]:
    """The header of a shown table."""
    return [label(name, column) for column in shown_columns(name, table)]


def label(name: str, column: str) -> str:
    """How a person calls a column of a shown table."""
    return COLUMNS[name].get(column, column.replace("_", " "))


def cells(name: str, row: Row, table: Table) -> list[tuple[str, bool]]:
    """A row of a shown table as texts, intervals included, and whether each is a number."""
    texts = []
    for column in shown_columns(name, table):
        value = row[column]
        text = number(value, column)
        low, high = _ENDS.get((name, column), ("", ""))
        if low and row[low] == row[low]:
            text += f" ({number(row[low], column)} to {number(row[high], column)})"
        texts.append((text, isinstance(value, int | float) and not isinstance(value, bool)))
    return texts


def shown_columns(name: str, table: Table) -> list[str]:
    """The columns of a table that are shown: without a baseline no differences to one, of one family not its name.

    Of `why` there are further ones: what pays points in the game.
    """
    hidden = set()
    if name == "scores" and not any(row["baseline"] for row in table):
        hidden |= {"difference", "said"}
    if len({row.get("family") for row in table}) == 1:
        hidden.add("family")
    if table:
        hidden |= COLUMNS[name].keys() - table[0].keys()
    more = [column for column in table[0] if column not in COLUMNS[name]] if name == "why" and table else []
    return [column for column in (*COLUMNS[name], *more) if column not in hidden]


def number(value: object, column: str = "") -> str:
    """A table's value as a person reads it."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if not isinstance(value, int | float):
        return str(value)
    if value != value:
        return ""
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
    """A shown table as texts, header first."""
    return [titles(name, table), *([text for text, _ in cells(name, row, table)] for row in table)]
