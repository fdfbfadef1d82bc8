"""Update the tables in docs/data, and read the arguments of the scripts beside it."""

import argparse
import csv
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path

RANDOM = 20_873  # a random player's mean (docs/reproduction.md)

Row = dict[str, str]


def arguments(doc: str | None, names: Collection[str] = ()) -> argparse.Namespace:
    """Parse a script's arguments: `name`, one of `names` if there are any, and `outputs`, folders or files."""

    def existing(text: str) -> Path:
        if not (path := Path(text)).exists():
            raise argparse.ArgumentTypeError(f"{text}: no such file or folder")
        return path

    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    if names:
        parser.add_argument("name", choices=names)
    parser.add_argument("outputs", nargs="*", type=existing, help="what new rows come from; none: draw the table again")
    return parser.parse_args()


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
