"""What a person is told about an evaluation."""

import io
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from atlantis_exp.training.evaluation import Episode, Evaluation
from atlantis_exp.training.progress import Progress


@pytest.mark.parametrize(
    ("score", "frames", "explained"),
    [(12_849.0, 10_000_000, True), (12_850.0, 10_000_000, False), (12_849.0, 10_000_001, False)],
)
def test_an_early_score_below_random_is_explained(score: float, frames: int, explained: bool) -> None:
    text = io.StringIO()
    trainer: Any = SimpleNamespace(counters=SimpleNamespace(steps=7, frames=frames))
    Progress(Console(file=text, width=300)).evaluated(trainer, Evaluation(0.1, [Episode(0, score, 4)]))
    assert f"mean {score:,.0f}" in text.getvalue()
    assert ("at 5 M frames published DQN is at 7,000 to 9,000" in text.getvalue()) == explained
