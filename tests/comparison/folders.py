"""Comparisons of recorded runs."""

from pathlib import Path

from atlantis_exp.comparison.choosing import group
from atlantis_exp.comparison.gather import gather
from atlantis_exp.comparison.tables import Comparison, compare
from atlantis_exp.comparison.verdict import Question


def compared_by(outputs: Path, key: str = "model") -> Comparison:
    """Compare all runs under an outputs folder."""
    gathered = gather(outputs)
    return compare(gathered, group(gathered.trainings, [key]), Question([key]))
