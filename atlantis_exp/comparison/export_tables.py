"""Tables of a comparison for a paper: LaTeX and Parquet, with units in the header."""

import io
import re
import unicodedata
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Any

from atlantis_exp.comparison.gather import AXES
from atlantis_exp.comparison.published import Row, Table
from atlantis_exp.comparison.report import COLUMNS, SHARES, cells, label, number, shown_columns
from atlantis_exp.components import facts_of, known

_FRACTION = "fraction"
"""The unit of shares and probabilities, from 0 to 1; LaTeX has percent instead, as a person reads them."""

_POINTS = (
    *("iqm", "iqm_low", "iqm_high", "mean", "mean_low", "mean_high", "median", "median_low", "median_high"),
    *("low", "high", "lower_quartile", "upper_quartile", "standard_error", "score", "tau"),
    *("leader_score", "other_score", "difference", "difference_low", "difference_high"),
    *("upper_score", "lower_score", "detectable", "delta", "score_low", "score_high"),
    *("later_score", "other_later_score"),
    *(source for game in known("env").values() for source in facts_of(game).sources),
)

UNITS: Mapping[str, str] = {
    **dict.fromkeys(_POINTS, "points"),
    **dict.fromkeys(sorted(SHARES), _FRACTION),
    "score_per_1000_steps": "points",
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
"""A column of a comparison's tables, or of `load_runs`, to its unit; frames are the emulator's, FLOPs those of gradient
updates. A column that is not here counts something that its name says, or is no quantity."""

_UNITS_OF: Mapping[str, Mapping[str, str]] = {
    "partings": {"step": "steps", "frame": "frames"},
    "improvement": {"low": _FRACTION, "high": _FRACTION},
    "profile": {"low": _FRACTION, "high": _FRACTION},
}
"""Where a table's column has another unit than that of its name elsewhere."""

_AXIS_UNITS = {name: UNITS[axis] for axis, view in AXES.items() for name in (axis, view)}
"""The unit in which a row's `at` or `x` is, by its `view` or `axis`."""


def unit(name: str, column: str) -> str:
    """The unit of a column of a comparison's table, empty where it has none or one a row (`at` and `x`)."""
    if name == "why" and column not in COLUMNS["why"]:  # what pays points in the game
        return UNITS["points_per_1000_frames"]
    return _UNITS_OF.get(name, {}).get(column, UNITS.get(column, ""))


def with_units(name: str, table: Table) -> Table:
    """The same rows with their units in the keys, as in `iqm (points)`; a key that is its unit stays, as `frames`."""
    return [{_with_unit(key, unit(name, key)): value for key, value in row.items()} for row in table]


def to_latex(name: str, table: Table) -> str:
    """A table as a LaTeX tabular in the manner of the package booktabs, empty for an empty table.

    A table that the page shows has the page's columns and headers, another one all of its own. Numbers have thousands
    separators, intervals are written as `a (b to c)`, and shares are in percent. Every character that LaTeX would read
    as more than itself is escaped.
    """
    if not table:
        return ""
    known = name in COLUMNS
    columns = (
        {column: label(name, column) for column in shown_columns(name, table)}
        if known
        else {key: key.replace("_", " ") for key in _shown(table)}
    )
    header = [
        _escaped(_with_unit(label, "%" if (of := unit(name, column)) == _FRACTION else of))
        for column, label in columns.items()
    ]
    rows = [_cells(name, row, table, columns, known) for row in table]
    sides = ["r" if any(row[i][1] for row in rows) else "l" for i in range(len(columns))]
    lines = [
        f"% The table {' '.join(name.split())} of a comparison; it needs \\usepackage{{booktabs}}.",
        rf"\begin{{tabular}}{{{''.join(sides)}}}",
        r"\toprule",
        " & ".join(header) + r" \\",
        r"\midrule",
        *(" & ".join(text for text, _ in row) + r" \\" for row in rows),
        r"\bottomrule",
        r"\end{tabular}",
        "",
    ]
    return "\n".join(lines)


def to_parquet(name: str, table: Table) -> bytes:
    """A table as a Parquet file with the keys of `with_units`; each column's metadata has its `unit`, too.

    Missing values (None, and the empty text among numbers) are null. A column that mixes texts with numbers is of
    texts. An empty table is a file without columns.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    arrays, fields = [], []
    for key in _keys(table):
        array = pa.array(_plain([row.get(key) for row in table]))
        of = unit(name, key)
        arrays.append(array)
        fields.append(pa.field(_with_unit(key, of), array.type, metadata={"unit": of} if of else None))
    file = io.BytesIO()
    pq.write_table(pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata={"table": name})), file)
    return file.getvalue()


def _keys(table: Table) -> list[str]:
    return list(dict.fromkeys(key for row in table for key in row))


def _shown(table: Table) -> list[str]:
    """The keys of a table but for the ends of intervals, which are written with their values."""
    keys = _keys(table)
    ends = {f"{key}_{end}" for key in keys for end in ("low", "high")}
    return [key for key in keys if key not in ends]


def _with_unit(label: str, of: str) -> str:
    return label if not of or label.lower() == of.lower() else f"{label} ({of})"


def _cells(name: str, row: Row, table: Table, columns: Iterable[str], known: bool) -> list[tuple[str, bool]]:
    """A row as LaTeX without the units that its header has, intervals included, and whether each is a number."""
    missing = {key for key, value in row.items() if _is_missing(value) and not (known and value is None)}
    given = {key: "" if key in missing and key in columns else value for key, value in row.items()}
    texts = cells(name, given, table) if known else [_cell(name, given, column) for column in columns]
    shown = []
    for column, (text, is_number) in zip(columns, texts, strict=True):
        if column in missing or (not known and column not in row):
            shown.append(("--", False))
        elif not is_number:
            shown.append((_escaped(text), False))
        else:
            if unit(name, column) == _FRACTION:
                text = text.replace("%", "")
            elif column in ("at", "x"):
                text = f"{text} {_AXIS_UNITS.get(str(row.get('view', row.get('axis'))), '')}".rstrip()
            shown.append((_number(text), True))
    return shown


def _cell(name: str, row: Row, column: str) -> tuple[str, bool]:
    value, low, high = (row.get(key) for key in (column, f"{column}_low", f"{column}_high"))
    as_shown = column if unit(name, column) != _FRACTION else "share"
    text = "" if value is None else number(value, as_shown)
    if not (_is_missing(low) or _is_missing(high)):
        text += f" ({number(low, as_shown)} to {number(high, as_shown)})"
    return text, isinstance(value, int | float) and not isinstance(value, bool)


def _is_missing(value: Any) -> bool:
    return value is None or bool(value != value)


def _plain(values: list[Any]) -> list[Any]:
    """Values of one type, as Parquet takes them."""
    values = [value.item() if hasattr(value, "item") else value for value in values]
    kinds = {"number" if type(value) in (int, float) else type(value).__name__ for value in values if value is not None}
    if kinds == {"number", "str"}:
        values = [None if value == "" else value for value in values]
        kinds = {"number" if isinstance(value, int | float) else "str" for value in values if value is not None}
    if len(kinds) <= 1:
        return values
    return [value if value is None else str(value) for value in values]


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
    '"': r"\symbol{34}",  # which German makes a command
    "`": r"\symbol{96}",
}


@lru_cache(10_000)  # the same labels stand in thousands of rows
def _escaped(text: str) -> str:
    """A text as LaTeX that shows just its characters, on one line; what is no character to be seen is a space."""
    seen = "".join(" " if unicodedata.category(letter)[0] in "CZ" else letter for letter in text)
    latex = "".join(_LATEX.get(letter, letter) for letter in " ".join(seen.split()))
    latex = re.sub(r"([-,'])(?=\1)", r"\1{}", latex)  # two of them are a dash or a quotation mark
    return f"{{}}{latex}" if latex.startswith(("[", "*")) else latex  # else an argument of the line's end before it


def _number(text: str) -> str:
    """A number that `report.number` wrote, interval included, as LaTeX."""
    text = re.sub(r"(\d)e\+?(-?)0*(\d+)", r"\1$\\times10^{\2\3}$", _escaped(text))
    return re.sub(r"(?<![\w{])-(?=\d)", "$-$", text)
