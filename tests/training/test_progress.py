"""What a person is told about an evaluation."""

import io
import itertools
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from atlantis_exp.training.evaluation import Episode, Evaluation
from atlantis_exp.training.progress import Progress


def test_an_evaluation_says_how_far_it_is_now_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    text, clock = io.StringIO(), itertools.count(100, 4)  # seconds
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    progress = Progress(Console(file=text, width=300))
    episodes = [Episode(0, 1_200.0), Episode(1), Episode(2)]
    for over in range(7):
        episodes[1].actions.append(0)
        progress.evaluating(episodes, over // 3)
    assert text.getvalue().splitlines() == [
        "  evaluation: 1 of 3 episodes over, 4 steps, highest score 1,200",
        "  evaluation: 2 of 3 episodes over, 7 steps, highest score 1,200",
    ]


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
