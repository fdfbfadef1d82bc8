"""Read and write a comparison's looks, `looks.json` in its folder."""

import json
from collections.abc import Collection, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter, ValidationError

from atlantis_exp.comparison.decision import FEWEST_SEEDS, Look
from atlantis_exp.comparison.verdict import Answer, Family
from atlantis_exp.faults import Fault
from atlantis_exp.runs.files import SMALL, read_file, write_file
from atlantis_exp.runs.folder import CONFIG, LOOKS

RECORD = TypeAdapter(dict[str, list[Look]])

Record = dict[str, list[Look]]
"""The looks of each family, in order."""


def read_looks(folder: Path, families: Sequence[Family], continued: Collection[str] = ()) -> Record:
    """Read the looks taken at some families; empty before the first.

    continued: families that may have looks of an earlier question with another plan.

    Raises: Fault if the file does not fit these families, or is missing from a comparison that was made.
    """
    path = folder / LOOKS
    if not path.exists():
        if (folder / CONFIG).exists():  # written after the looks
            raise Fault(f"{path} is gone: restore it, since without it the error of its looks would be spent again")
        return {}
    try:
        record = RECORD.validate_json(read_file(path, SMALL), strict=True)
        if unknown := record.keys() - {family.name for family in families}:
            raise ValueError(f"it has looks at {min(unknown)!r}")
        for family in families:
            _check(family, record.get(family.name, []), family.name in continued)
    except (ValueError, OSError) as error:
        reason = "its form is wrong" if isinstance(error, ValidationError) else error
        raise Fault(
            f"{path} is not a record of this comparison's looks ({reason}): restore it, since without it their error "
            f"would be spent again"
        ) from None
    return record


def write_looks(folder: Path, answers: Sequence[Answer]) -> None:
    """Write the looks of all families; call it before showing their verdicts."""
    record = {answer.family.name: [asdict(look) for look in answer.decision.looks] for answer in answers}
    write_file(folder / LOOKS, json.dumps(record, indent=1).encode())


def _check(family: Family, looks: Sequence[Look], is_continued: bool) -> None:
    """Raise ValueError for looks that cannot follow from the family's plan."""
    open_pairs = sorted(family.plan.pairs(family.seeds))
    size, spent = FEWEST_SEEDS - 1, 0.0
    last = np.inf if is_continued else family.plan.looks[-1]
    for look in looks:
        pairs = sorted((verdict.group, verdict.other) for verdict in look.verdicts)
        if pairs != open_pairs or {name for pair in pairs for name in pair} != look.seeds.keys():
            raise ValueError(f"its looks by {family.name} are about other pairs")
        before, size = size, look.size
        sizes = {size, *(len({*seeds}) for seeds in look.seeds.values()), *(verdict.seeds for verdict in look.verdicts)}
        numbers = [value for verdict in look.verdicts for value in (verdict.difference, verdict.low, verdict.high)]
        if len(sizes) > 1 or not before < size <= last or not np.isfinite(numbers).all():
            raise ValueError(f"its looks by {family.name} have impossible numbers")
        spent += look.error
        planned = family.plan.spendable(size)
        if not (0 < spent <= 1 if is_continued else np.isclose(spent, planned, rtol=1e-6)):
            raise ValueError(f"its looks by {family.name} spent another error than the plan allows")
        for verdict in look.verdicts:
            found = {"better": verdict.low > 0, "worse": verdict.high < 0, "equivalent": family.plan.delta is not None}
            is_so = found.get(verdict.said, verdict.low <= 0 <= verdict.high)
            if not (is_so and verdict.low <= verdict.difference <= verdict.high):
                raise ValueError(f"its looks by {family.name} contradict their intervals")
        undecided = (verdict for verdict in look.verdicts if verdict.said == "not decided")
        open_pairs = sorted((verdict.group, verdict.other) for verdict in undecided)
