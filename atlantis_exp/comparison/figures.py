"""Draw the tables of a comparison; a group has its own colour and line style."""

import io
import re
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from html import escape
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from atlantis_exp.comparison.gather import AXES
from atlantis_exp.comparison.published import Table, random_line
from atlantis_exp.comparison.tables import Comparison
from atlantis_exp.media import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION, png_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY)
_LINES = ("-", "--", "-.", ":")
_HEIGHT = 3.2  # inches
_GREY = "#6e7781"  # of averages over several groups
_INK = "#24292f"  # of text and axes; the page replaces it by its own
_STYLE = {
    "text.parse_math": False,  # names may have dollar signs
    **dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), _INK),
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "atlantis_exp",
}
_UNITS = {
    "frames": "emulator frames of training",
    "hours": "hours of training, evaluations included",
    "flops": "floating-point operations of gradient updates",
}


@dataclass(frozen=True)
class Drawn:
    """A figure as a PNG, and as an SVG in the text colour of its page."""

    title: str
    alt: str  # description in words
    png: bytes
    svg: str


def draw(comparison: Comparison) -> dict[str, Drawn]:
    """Draw the figures of a comparison, by name, except those without data."""
    tables, groups, game = comparison.tables, comparison.groups, comparison.game
    drawn = dict[str, Drawn]()

    def add(name: str, plot: Callable[..., None], title: str, alt: str, height: float = _HEIGHT, **of: Any) -> None:
        drawn[name] = _render(partial(plot, comparison=comparison, **of), title, alt, height)

    for axis, view in AXES.items():
        if rows := [row for row in tables["curves"] if row["axis"] == axis]:
            add(
                *(f"learning_{axis}", _learning, f"Learning at {view}"),
                f"Training score, mean of 100 episodes, by {_UNITS[axis]}; at the last point that all runs of a group "
                f"reach: {_said(groups, rows, 'score')}",
                axis=axis,
                rows=rows,
            )
            if axis == "frames":
                add(
                    *("exploration", _exploration, "Exploration while training"),
                    "Epsilon by emulator frames of training, as in report figure 4.1; at the end: "
                    + _said(groups, rows, "epsilon", ".3f"),
                    rows=rows,
                )
    scores = tables["scores"]
    add(
        *("scores", _scores, "Scores"),
        "One dot per seed, the score as a diamond, with its 95 % interval from five seeds on; scores: "
        + _said([row["group"] for row in scores], scores, "score"),
        1.2 + 0.45 * len(scores),
    )
    if game.sources:
        add(
            *("why", _why, "Rate and survival"),
            "Points per 1,000 emulator frames, split by what paid them, and at each bar the mean frames of an episode; "
            "rates: " + _said(groups, tables["why"], "points_per_1000_frames"),
            1.6 + 0.6 * len(groups),
        )
    if not tables["evaluation"]:
        return drawn
    add(
        *("distribution", _distribution, "Distribution of the evaluated scores"),
        "Histogram of evaluated scores, one step line per group; medians: "
        + _said(groups, tables["evaluation"], "median"),
    )
    add(
        *("profile", _profile, "Share of episodes above a score"),
        "Performance profile: for each score the share of a group's episodes that exceed it.",
    )
    chance = {group: sum(row["random"] for row in tables["actions"] if row["group"] == group) for group in groups}
    add(
        *("actions", _actions, "Who chose which action"),
        "Share of each action in evaluation, split into network and chance; all actions of chance: "
        + "; ".join(f"{group} {share:.1%}" for group, share in chance.items()),
        1.2 + 0.6 * len(groups),
    )
    if tables["references"]:
        add(
            *("references", _references, "Against other players"),
            "Mean scores of the groups among measured players and published algorithms"
            + (", on a logarithmic axis." if game.is_logarithmic else "."),
            1.0 + 0.24 * (len(groups) + len(tables["references"])),
        )
    return drawn


def _render(plot: Callable[["Axes"], None], title: str, alt: str, height: float = _HEIGHT) -> Drawn:
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(_STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(4.8, height), dpi=150, facecolor="white", layout="constrained")
        plot(figure.add_subplot())
        png = png_of(figure)
        figure.set_layout_engine("none")  # keep the layout for both pictures
        return Drawn(title, alt, png, _svg(figure, alt))


def _svg(figure: "Figure", alt: str) -> str:
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    buffer = io.StringIO()
    for patch in (figure.patch, *(axes.patch for axes in figure.axes)):
        patch.set_visible(False)  # the page is the background
    FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})  # type: ignore[no-untyped-call]
    svg = buffer.getvalue()[buffer.getvalue().index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r' id="[a-z]+[a-z0-9]*_[0-9]+"', "", svg)  # of groups; what is referred to has a hash as name
    svg = re.sub(r' (width|height)="[0-9.]+pt"', "", svg, count=2)
    svg = svg.replace(_INK, "currentColor").replace("'DejaVu Sans', ", "")
    return svg.replace("<svg", f'<svg role="img" aria-label="{escape(alt)}"', 1)


def _said(groups: Sequence[str], rows: Table, column: str, style: str = ",.0f") -> str:
    last = {row["group"]: row[column] for row in rows}
    return ", ".join(f"{group} {last[group]:{style}}" for group in groups if group in last)


def _look(comparison: Comparison, group: str) -> dict[str, Any]:
    index = comparison.groups.index(group)
    return {"color": _COLOURS[index % len(_COLOURS)], "linestyle": _LINES[index % len(_LINES)]}


def _columns(rows: Table, group: str, *keys: str) -> list[list[float]]:
    """Return columns of a group's rows."""
    return [[row[key] for row in rows if row["group"] == group] for key in keys]


def _lines(axes: "Axes", comparison: Comparison, rows: Table, x: str, y: str) -> None:
    """Draw a line for each group."""
    for group in comparison.groups:
        axes.plot(*_columns(rows, group, x, y), label=group, **_look(comparison, group))


def thousands(axis: Any) -> None:
    """Format an axis as 20k for 2 x 10^4, on a logarithmic one also between powers of ten."""
    from matplotlib.ticker import EngFormatter, LogFormatter

    written = EngFormatter(sep="")
    axis.set_major_formatter(written)
    if axis.get_scale() == "log":

        class Between(LogFormatter):
            """Formats numbers between powers of ten if a logarithmic axis has room."""

            def __call__(self, x: float, pos: int | None = None) -> str:
                return written(x) if super().__call__(x, pos) else ""

        axis.set_minor_formatter(Between())


def _rows(axes: "Axes", names: Sequence[str], above: float = 0.8) -> None:
    """Name the rows of a figure, from the top."""
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.4, -above)


def _finish(axes: "Axes", x: str, y: str = "", *, is_logarithmic: bool = False, columns: int = 2) -> None:
    """Label the axes; grow the figure for a legend above them, in as many columns as fit."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    if is_logarithmic:
        axes.set_xscale("log")
    axes.set_xlabel(f"{x} (logarithmic)" if is_logarithmic else x)
    axes.set_ylabel(y)
    if x != _UNITS["hours"]:  # else half an hour would be 500m
        thousands(axes.xaxis)
    figure = axes.get_figure(root=True)
    if figure is None or not axes.get_legend_handles_labels()[0]:
        return
    renderer = FigureCanvasAgg(figure).get_renderer()  # type: ignore[no-untyped-call]
    for number in range(columns, 0, -1):
        legend = figure.legend(loc="outside upper left", ncols=number, fontsize=9, columnspacing=1)
        extent = legend.get_window_extent(renderer)
        if extent.width <= figure.bbox.width or number == 1:
            figure.set_figheight(figure.get_figheight() + extent.height / figure.dpi)
            return
        legend.remove()


def _reference_lines(draw_line: Callable[..., Any], comparison: Comparison, low: float, high: float) -> None:
    """Draw players' scores as grey lines, if they are near those of the groups."""
    references = comparison.tables["references"]
    least, most = (low / 2, high * 2) if comparison.game.is_logarithmic else (2 * low - high, 2 * high - low)
    shown = [row for row in references if row["kind"] == "player" and least <= row["score"] <= most]
    if (random := random_line(references)) and not random["protocol"].startswith("published"):
        shown = [row for row in shown if row["name"] != "random player"]
    styles = ((0, (1, 1)), (0, (4, 2)), (0, (6, 2, 1, 2)), (0, (2, 3)))
    for index, row in enumerate(shown):
        label = f"{row['name']}{', published' if 'published' in row['protocol'] else ''} ({row['score']:,.0f})"
        draw_line(row["score"], color="#8c8c8c", linewidth=1, linestyle=styles[index % len(styles)], label=label)


def _learning(axes: "Axes", comparison: Comparison, axis: str, rows: Table) -> None:
    seeds = [row for row in comparison.tables["seed_curves"] if row["axis"] == axis]
    ends = {row["group"]: row["score"] for row in rows}
    leading = sorted(ends, key=lambda group: -ends[group])[:2]  # more bands would hide each other
    _lines(axes, comparison, rows, "x", "score")
    for group in comparison.groups:
        look = _look(comparison, group)
        if group in leading:
            x, low, high = _columns(rows, group, "x", "low", "high")
            axes.fill_between(x, low, high, color=look["color"], alpha=0.2, linewidth=0)
        for run in dict.fromkeys(row["run"] for row in seeds if row["group"] == group):
            points = [(row["x"], row["score"]) for row in seeds if row["run"] == run]
            axes.plot(*zip(*points, strict=True), linewidth=0.6, alpha=0.6, **look)
    scores = [row["score"] for row in (*rows, *seeds)]
    _reference_lines(axes.axhline, comparison, min(scores), max(scores))
    axes.set_ylim(0 if min(scores) >= 0 else None, None)
    if axis == "frames":
        _published(axes, comparison.tables["published_curves"])
    axes.locator_params(axis="x", nbins=5)
    thousands(axes.yaxis)
    _finish(axes, _UNITS[axis], "training score, mean of 100")


def _published(axes: "Axes", rows: Table) -> None:
    """Draw published curves in grey, cut off if they would make the figure more than twice as high."""
    curves = defaultdict(list)
    for row in rows:
        curves[row["name"]].append((row["frames"], row["mean"]))
    low, high = axes.get_ylim()
    for (name, points), mark in zip(curves.items(), cycle("os^vDP*X"), strict=False):
        look: dict[str, Any] = {"color": "#8c8c8c", "marker": mark, "markersize": 4, "linewidth": 0.8}
        axes.plot(*zip(*points, strict=True), label=f"{name}, published", **look)
    bottom = low if low == 0 else max(axes.get_ylim()[0], 2 * low - high)
    axes.set_ylim(bottom, min(axes.get_ylim()[1], 2 * high - low))


def _exploration(axes: "Axes", comparison: Comparison, rows: Table) -> None:
    _lines(axes, comparison, rows, "x", "epsilon")
    axes.set_ylim(0, 1)
    axes.locator_params(axis="x", nbins=5)
    _finish(axes, _UNITS["frames"], "epsilon")


def _scores(axes: "Axes", comparison: Comparison) -> None:
    table = comparison.tables["scores"]
    for y, row in enumerate(table):
        group = row["group"]
        colour = _look(comparison, group)["color"] if group in comparison.groups else _GREY
        of_row = [
            seed["score"]
            for seed in comparison.tables["seeds"]
            if (seed["family"], seed["group"]) == (row["family"], group)
        ]
        axes.plot([row["low"], row["high"]], [y, y], color=colour, linewidth=3, alpha=0.45, solid_capstyle="butt")
        axes.plot(of_row, [y] * len(of_row), "o", color=colour, markersize=4, alpha=0.5)
        axes.plot(row["score"], y, "D", color=colour, markersize=6)
        axes.annotate(
            f"{row['score']:,.0f}", (row["score"], y), (0, 6), textcoords="offset points", ha="center", fontsize=8
        )
    ends = [seed["score"] for seed in comparison.tables["seeds"]]
    _reference_lines(axes.axvline, comparison, min(ends), max(ends))
    axes.margins(x=0.1)
    _rows(axes, [row["group"] for row in table])
    _finish(axes, "score, one dot a seed")


def _why(axes: "Axes", comparison: Comparison) -> None:
    rows = comparison.tables["why"]
    for y, row in enumerate(rows):
        rate, left = row["points_per_1000_frames"], 0.0
        for source, colour in zip(comparison.game.sources, cycle(_COLOURS)):
            label = source.replace("_", " ") if y == 0 else None
            axes.barh(y, row[source], 0.6, left, color=colour, label=label)
            left += row[source]
        said = f"{row['frames_mean']:,.0f} frames"
        if left != left:  # NaN: recorded by an older version
            axes.barh(y, rate, 0.6, color=_GREY)
            said += ", split not recorded"
        axes.annotate(said, (rate, y), (4, 0), textcoords="offset points", va="center", fontsize=8)
    rates = [row["points_per_1000_frames"] for row in rows]
    if min(rates) >= 0:
        axes.set_xlim(0, 1.45 * max(rates) or 1)
    _rows(axes, [row["group"] for row in rows], 0.6)
    _finish(axes, "points per 1,000 frames")


def _distribution(axes: "Axes", comparison: Comparison) -> None:
    episodes = comparison.tables["episodes"]
    everything = [row["score"] for row in episodes]
    edges = np.linspace(min(0.0, *everything), max(1.0, *everything), 31).tolist()  # 30 bins, as in report figure 3.1
    for group in comparison.groups:
        (scores,) = _columns(episodes, group, "score")
        look = {"weights": [1 / len(scores)] * len(scores), **_look(comparison, group)}
        axes.hist(scores, edges, histtype="stepfilled", alpha=0.15, **look)
        axes.hist(scores, edges, histtype="step", label=group, **look)
    _finish(axes, "score", "share of episodes")


def _profile(axes: "Axes", comparison: Comparison) -> None:
    _lines(axes, comparison, comparison.tables["profile"], "tau", "share")
    axes.set_ylim(0, 1.03)
    _finish(axes, "score", "share of episodes above", is_logarithmic=comparison.game.is_logarithmic)


def _actions(axes: "Axes", comparison: Comparison) -> None:
    for y, group in enumerate(comparison.groups):
        left = 0.0
        rows = [row for row in comparison.tables["actions"] if row["group"] == group]
        for row, colour in zip(rows, cycle(_COLOURS), strict=False):
            label = row["action"] if y == 0 else None
            axes.barh(y, row["network"], 0.6, left, color=colour, label=label)
            axes.barh(y, row["random"], 0.6, left + row["network"], color=colour, hatch="////", edgecolor="white")
            left += row["network"] + row["random"]
    _rows(axes, comparison.groups, 0.6)
    axes.set_xlim(0, 1)
    _finish(axes, "share of steps (hatched: by chance)", columns=4)
    axes.xaxis.set_major_formatter("{x:.0%}")


def _references(axes: "Axes", comparison: Comparison) -> None:
    bars = [
        (row["name"], row["score"], "#b0b0b0" if row["kind"] == "algorithm" else "#7a7a7a")
        for row in comparison.tables["references"]
    ]
    bars += [
        (row["group"], row["mean"], _look(comparison, row["group"])["color"]) for row in comparison.tables["evaluation"]
    ]
    bars.sort(key=lambda bar: bar[1])
    names, scores, colours = zip(*bars, strict=True)
    axes.barh(range(len(bars)), scores, 0.7, color=colours)
    axes.set_yticks(range(len(bars)), names, fontsize=8)
    axes.set_ylim(-0.6, len(bars) - 0.4)
    for y, score in enumerate(scores):
        axes.annotate(f"{score:,.0f}", (score, y), (4, 0), textcoords="offset points", va="center", fontsize=7)
    axes.margins(x=0.12)
    _finish(axes, "mean score", is_logarithmic=comparison.game.is_logarithmic)
