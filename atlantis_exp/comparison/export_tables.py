"""Write tables of a comparison for a paper, with units in the header."""

import re
import unicodedata
from collections.abc import Mapping
from functools import lru_cache

from atlantis_exp.comparison.page import COLUMNS, SHARES, cells, label, shown_columns
from atlantis_exp.comparison.published import Table
from atlantis_exp.components import facts_of, known

_FRACTION = "fraction"
"""The unit of shares and probabilities, from 0 to 1; LaTeX and the page have them in percent."""

UNITS: Mapping[str, str] = {
    **dict.fromkeys(
        (
            *("score", "iqm", "mean", "median", "low", "high", "lower_quartile", "upper_quartile", "standard_error"),
            *("tau", "leader_score", "other_score", "upper_score", "lower_score", "detectable"),
            *("difference", "difference_low", "difference_high"),
            *(source for game in known("env").values() for source in facts_of(game).sources),
        ),
        "points",
    ),
    **dict.fromkeys(sorted(SHARES), _FRACTION),
    "points_per_frame": "points/frame",
    "points_per_1000_frames": "points/1,000 frames",
    "frames": "frames",
    "frames_mean": "frames",
    "steps": "steps",
    "steps_mean": "steps",
    "hours": "hours",
    "flops": "FLOPs",
    **dict.fromkeys(("seeds", "next_look"), "seeds"),
}
"""The units of columns in a comparison's tables and in `load_runs`. Frames are the emulator's, FLOPs those of gradient
updates. Other columns count what their name says, or are not quantities."""


def unit(name: str, column: str) -> str:
    """Return the unit of a table's column; empty if it has none, or one per row (`at` and `x`)."""
    if name == "why" and column not in COLUMNS["why"]:  # a source of points in the game
        return UNITS["points_per_1000_frames"]
    return UNITS.get(column, "")


def with_units(name: str, table: Table) -> Table:
    """Return rows with units in their keys, as in `iqm (points)`; a key that is its own unit stays: `frames`."""
    return [{_with_unit(key, unit(name, key)): value for key, value in row.items()} for row in table]


def to_latex(name: str, table: Table) -> str:
    """Write a table as a LaTeX tabular for the package booktabs; an empty table gives an empty text.

    Columns, headers and cells are those of the page; a table that is not on the page has all its columns. Characters
    that are special to LaTeX are escaped.
    """
    if not table:
        return ""
    columns = shown_columns(name, table)
    units = (unit(name, column) for column in columns)
    header = [
        _with_unit(label(name, column), "" if of == _FRACTION else of)
        for column, of in zip(columns, units, strict=True)
    ]
    rows = [cells(name, row, columns) for row in table]
    sides = ["r" if any(is_number for _, is_number in column) else "l" for column in zip(*rows, strict=True)]
    lines = [[_number(text) if is_number else _escaped(text) for text, is_number in row] for row in rows]
    return "\n".join(
        [
            f"% The table {' '.join(name.split())} of a comparison; it needs \\usepackage{{booktabs}}.",
            rf"\begin{{tabular}}{{{''.join(sides)}}}",
            r"\toprule",
            " & ".join(map(_escaped, header)) + r" \\",
            r"\midrule",
            *(" & ".join(line) + r" \\" for line in lines),
            r"\bottomrule",
            r"\end{tabular}",
            "",
        ]
    )


def _with_unit(label: str, of: str) -> str:
    return label if not of or label.lower() == of.lower() else f"{label} ({of})"


_LATEX = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "#": r"\#",
    "%": r"\%",
    "_": r"\_",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\symbol{34}",  # a command in German documents
    "`": r"\symbol{96}",
}


@lru_cache(10_000)  # thousands of rows repeat the same labels
def _escaped(text: str) -> str:
    """Escape a text for LaTeX, on one line; non-printing characters become spaces."""
    seen = "".join(" " if unicodedata.category(letter)[0] in "CZ" else letter for letter in text)
    latex = "".join(_LATEX.get(letter, letter) for letter in " ".join(seen.split()))
    latex = re.sub(r"([-,'])(?=\1)", r"\1{}", latex)  # two of them make a dash or a quotation mark
    return f"{{}}{latex}" if latex.startswith(("[", "*")) else latex  # else an argument of the previous line's end


def _number(text: str) -> str:
    """Write a number of `page.number`, with its interval, as LaTeX."""
    text = re.sub(r"(\d)e\+?(-?)0*(\d+)", r"\1$\\times10^{\2\3}$", _escaped(text))
    return re.sub(r"(?<![\w{])-(?=\d)", "$-$", text)
