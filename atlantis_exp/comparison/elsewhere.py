"""Read the scores of seeds trained elsewhere from a CSV file."""

import csv
import io
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from statistics import fmean

from atlantis_exp.checking import nearest
from atlantis_exp.comparison.verdict import Group
from atlantis_exp.faults import ConfigError
from atlantis_exp.runs.files import SMALL, read_file

_COLUMNS = ("group", "seed", "score")
_MOST_GROUPS = 100
_MOST_SEEDS = 10_000  # of a group, as many as a plan may have
_LONGEST = 100  # characters of a group's name


def read_scores(path: Path, columns: Mapping[str, str]) -> list[Group]:
    """Read groups from a table with one row per episode, evaluation or seed; average the rows of a seed.

    columns: names of the columns for group, seed and score, if they differ. Other columns are ignored.

    Raises: ConfigError that names the row and the column.
    """
    columns = dict(zip(_COLUMNS, _COLUMNS, strict=True)) | dict(columns)
    found: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    try:
        reader = csv.DictReader(
            io.StringIO(read_file(path.resolve(), SMALL).decode("utf-8-sig"), newline=""), strict=True
        )
        header = reader.fieldnames or []
        for key, name in columns.items():
            if header.count(name) != 1:
                which = "several such columns" if name in header else f"no such column; {nearest(name, header)}"
                raise ValueError(f"row 1, column {name}: {which}; set columns={key}=NAME")
        for row in reader:
            label, seed, score = (_read(reader.line_num, row, columns, key) for key in _COLUMNS)
            found[str(label)][int(seed)].append(float(score))
            if len(found) > _MOST_GROUPS or len(found[str(label)]) > _MOST_SEEDS:
                raise ValueError(
                    f"row {reader.line_num}, column {columns['group']}: more than {_MOST_GROUPS} groups or "
                    f"{_MOST_SEEDS:,} seeds of one"
                )
    except (ValueError, OSError, csv.Error) as error:
        raise ConfigError(f"scores={path}: {getattr(error, 'strerror', None) or error}") from None
    if not found:
        raise ConfigError(f"scores={path}: row 2, column {columns['group']}: no row below the header")
    return [
        Group((label,), {seed: fmean(scores) for seed, scores in sorted(seeds.items())})
        for label, seeds in sorted(found.items())
    ]


def _read(line: int, row: Mapping[str | None, str | None], columns: Mapping[str, str], key: str) -> str | int | float:
    """Return a row's value of a key. Raises: ValueError."""
    text = (row[columns[key]] or "").strip()
    place = f"row {line}, column {columns[key]}: {text[:_LONGEST]!r}"
    if key == "group":
        if not 0 < len(text) <= _LONGEST or not text.isprintable():
            raise ValueError(f"{place} is not a name of 1 to {_LONGEST} printable characters")
        return text
    try:
        value = int(text) if key == "seed" else float(text)
    except ValueError:
        value = float("nan")
    if key == "seed" and not 0 <= value < 2**63:
        raise ValueError(f"{place} is not a seed, a whole number from 0 on")
    if key == "score" and not abs(value) <= 1e15:  # so that squares stay finite
        raise ValueError(f"{place} is not a number up to 1e15")
    return value
