"""What a person is told, and the pace of a training."""

import io
from collections.abc import Sequence
from dataclasses import dataclass

import pytest
from rich.console import Console

from atlantis_exp.components import facts_of, game_of
from atlantis_exp.training.evaluation import Episode, Evaluation
from atlantis_exp.training.plan import Counters
from atlantis_exp.training.progress import Pace, Progress
from atlantis_exp.training.recorder import Played, line_of


@dataclass
class Clock:
    """Shows the time that it is set to."""

    now: float = 100.0  # seconds

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def test_an_evaluation_says_how_far_it_is_now_and_then(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    text = io.StringIO()
    monkeypatch.setattr("time.monotonic", clock)
    progress = Progress(Console(file=text, width=300))
    episodes = [Episode(0, 1_200.0), Episode(1), Episode(2)]
    for step in range(60):
        episodes[0].over = step >= 30
        episodes[1].actions.append(0)
        episodes[1].frames += 10
        progress.evaluating(episodes, 1_000)
        clock.now += 2
    assert text.getvalue().splitlines() == [
        "  evaluation: 0 of 3 episodes over, 3 steps, highest score 1,200, at most 0:06:36 left",
        "  evaluation: 0 of 3 episodes over, 7 steps, highest score 1,200, at most 0:08:22 left",
        "  evaluation: 0 of 3 episodes over, 15 steps, highest score 1,200, at most 0:08:52 left",
        "  evaluation: 0 of 3 episodes over, 30 steps, highest score 1,200, at most 0:08:42 left",
        "  evaluation: 1 of 3 episodes over, 45 steps, highest score 1,200, at most 0:01:34 left",
        "  evaluation: 1 of 3 episodes over, 60 steps, highest score 1,200, at most 0:01:43 left",
    ]


@pytest.mark.parametrize(
    ("score", "frames", "explained"),
    [(12_849.0, 10_000_000, True), (12_850.0, 10_000_000, False), (12_849.0, 10_000_001, False)],
)
def test_an_early_score_below_random_is_explained(score: float, frames: int, explained: bool) -> None:
    text = io.StringIO()
    Progress(Console(file=text, width=300)).evaluated(
        7, frames, Evaluation(0.1, [Episode(0, score, 4)], facts_of(game_of("Atlantis-v0")))
    )
    assert text.getvalue().startswith("step 7, 1 episodes evaluated at epsilon 0.1: ")
    assert f"mean {score:,.0f}" in text.getvalue()
    assert ("at 5 M frames published DQN is at 7,000 to 9,000" in text.getvalue()) == explained


PLAYED = [Played(1, 9, 27, score, length, 0) for score, length in [(1_000.0, 789)] * 19 + [(3_000.0, 812)]]


def said(
    steps: int = 12_345,
    left: float | None = 930_000.9,
    pace: float = 1_234.4,
    *,
    played: Sequence[Played] = PLAYED,
    updates: int = 3_000,
) -> tuple[str, float]:
    counters = Counters(steps=steps, episodes=1_012 if played else 0)
    return line_of(counters, played, 0.125, updates, pace, "fast", left)


def test_a_line_says_how_far_a_training_is() -> None:
    assert said()[0] == (
        "episode 1,013  score 3,000  mean of 20 1,100  duration 812 (mean of 100 790)  epsilon 0.12  "
        "step 12,345  updates 3,000  1,234 steps/s  phase fast  1.3%  left 0:12:33"
    )


def test_the_line_of_a_first_episode_has_no_score_yet() -> None:
    assert said(0, None, 0.0, played=[], updates=0) == (
        "episode 1  first episode  epsilon 0.12  step 0  updates 0  0 steps/s  phase fast  0.0%  left ?",
        0.0,
    )


@pytest.mark.parametrize(
    ("steps", "left", "share"), [(0, None, 0.0), (250, 750.0, 0.25), (1_000, 0.0, 1.0), (1_003, -3.0, 1.0)]
)
def test_the_share_is_of_all_steps_until_the_end(steps: int, left: float | None, share: float) -> None:
    line, found = said(steps, left)
    assert found == share
    assert f"  {share:.1%}  left " in line


@pytest.mark.parametrize(
    ("left", "pace", "shown"),
    [
        (None, 10.0, "?"),
        (100.0, 0.0, "?"),
        (0.0, 10.0, "0:00:00"),
        (-5.0, 10.0, "0:00:00"),
        (36_005.0, 10.0, "1:00:00"),
        (864_000.0, 10.0, "24:00:00"),
    ],
)
def test_the_time_left_follows_from_the_pace(left: float | None, pace: float, shown: str) -> None:
    assert said(12_345, left, pace)[0].endswith(f"  left {shown}")


def test_before_the_first_update_the_pace_says_nothing_of_the_time_left() -> None:
    assert said(updates=0)[0].endswith("  left ?")


@pytest.mark.parametrize(("terminal", "seconds", "at_once"), [(False, 4.0, False), (True, 0.25, True)])
def test_a_training_is_shown_a_few_times_a_second_on_a_terminal_and_now_and_then_elsewhere(
    clock: Clock, monkeypatch: pytest.MonkeyPatch, terminal: bool, seconds: float, at_once: bool
) -> None:
    monkeypatch.setattr("time.monotonic", clock)
    progress = Progress(Console(file=io.StringIO(), width=300, force_terminal=terminal))
    assert progress.is_due() == at_once
    if at_once:
        progress.show("episode 1", 0.5)
    clock.now += seconds - 0.125
    assert not progress.is_due()
    clock.now += 0.125
    assert progress.is_due()
    progress.show("episode 1", 0.5)
    assert not progress.is_due()
    progress.close()


def test_the_pace_is_that_of_the_last_half_minute(clock: Clock) -> None:
    pace, steps = Pace(clock), 0
    pace.tick(steps)
    for second in range(120):
        clock.now += 1
        steps += 10 if second < 60 else 40
        pace.tick(steps)
        assert second >= 60 or pace.steps_per_second == 10
    assert pace.steps_per_second == 40


def test_before_two_ticks_there_is_no_pace(clock: Clock) -> None:
    pace = Pace(clock)
    assert pace.steps_per_second == 0
    pace.tick(5_000)
    assert pace.steps_per_second == 0
    clock.now += 0.5
    pace.tick(5_004)
    assert pace.steps_per_second == 8


def test_a_pause_counts_neither_as_time_nor_as_a_new_beginning(clock: Clock) -> None:
    pace = Pace(clock)
    pace.tick(0)
    clock.now += 1
    pace.tick(10)
    with pace.paused():
        clock.now += 1_000
    assert pace.steps_per_second == 10
    for steps in range(20, 320, 10):
        clock.now += 1
        pace.tick(steps)
        assert pace.steps_per_second == pytest.approx(10)


def test_steps_between_two_marks_count(clock: Clock) -> None:
    pace = Pace(clock)
    for steps in range(0, 100, 2):
        pace.tick(steps)
        clock.now += 0.001
    assert pace.steps_per_second == pytest.approx(2_000)
