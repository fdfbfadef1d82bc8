"""Update the tables in docs/data, for the scripts beside it."""

import csv
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path

RANDOM = 20_873  # a random player's mean (docs/reproduction.md)

Row = dict[str, str]


def updated(
    table: Path,
    columns: Sequence[str],
    runs: Collection[str],
    rows: Iterable[Row],
    key: Callable[[Row], tuple[str, ...]],
) -> list[Row]:
    """Replace the rows of the named runs in a table; return all rows sorted by `key`."""
    known = table.read_text().splitlines() if table.exists() else []
    kept = [row for row in csv.DictReader(known) if row["run"] not in runs]
    merged = sorted([*kept, *rows], key=key)
    with table.open("w") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(merged)
    return merged
