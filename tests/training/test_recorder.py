"""What a training writes down, and what a person is told of it."""

import csv
import io
import itertools
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console

from atlantis_exp.runs.journal import NOTE, Image, Metrics, Tags, read
from atlantis_exp.training.recorder import Played
from atlantis_exp.training.trainer import Trainer

Small = Callable[..., Trainer]


def after(stops: int) -> Callable[[], bool]:
    """A stop request that comes once `stop` was asked that often."""
    asked = itertools.count()
    return lambda: next(asked) >= stops


def curve(folder: Path, key: str) -> list[tuple[int, float]]:
    records = [record for _, record in read(folder) if isinstance(record, Metrics)]
    return [(record.step, record.values[key]) for record in records if key in record.values]


def test_a_collapsed_policy_is_tagged_and_told(small: Small, tmp_path: Path) -> None:
    told = Console(record=True, file=io.StringIO(), width=200)
    trainer = small(tmp_path, console=told, learn_start=10**6, evaluate_steps=None)
    with torch.no_grad():
        for parameter in trainer.learner.network.parameters():
            parameter.zero_()
        list(trainer.learner.network.parameters())[-1][2] = 1.0
    trainer.run()
    policy = "collapsed: RIGHTFIRE in 100.0% of the network's decisions"
    tags = {
        key: value for _, record in read(tmp_path) if isinstance(record, Tags) for key, value in record.values.items()
    }
    assert tags["policy"] == policy
    assert f"warning: the policy has {policy}" in told.export_text()


def test_curves_of_any_num_envs_share_their_steps_and_raw_scores_stand_where_they_happened(
    small: Small, tmp_path: Path
) -> None:
    for num_envs in (1, 3):
        trainer = small(tmp_path / f"{num_envs}", num_envs=num_envs, episode_steps=35)
        trainer.run()
        assert [step for step, _ in curve(tmp_path / f"{num_envs}", "actions/epsilon")] == list(range(20, 161, 20))
        for key in ("score/mean_20", "score/mean_100", "score/length_mean_100", "throughput/episodes"):
            assert {step % 20 for step, _ in curve(tmp_path / f"{num_envs}", key)} == {0}, key
        evaluated = [step for step, _ in curve(tmp_path / f"{num_envs}", "evaluation/mean")]
        assert evaluated == [80, trainer.counters.steps]
        raw = curve(tmp_path / f"{num_envs}", "score/episode")
        assert [step for step, _ in raw] == [played.step for played in trainer.recorder.episodes]
        assert {step % 35 for step, _ in raw} == {0}


def test_the_table_of_episodes_is_whole_after_a_kill_and_agrees_with_the_journal(small: Small, tmp_path: Path) -> None:
    def begun(name: str) -> Trainer:
        return small(tmp_path / name, num_envs=3, episode_steps=15, evaluate_steps=40)

    begun("unbroken").run()
    killed = begun("broken")
    killed.run(after(20))
    killed.commit = lambda: None  # type: ignore[method-assign]
    killed.run(after(12))  # writes a table of what is then lost
    begun("broken").run()
    table = (tmp_path / "broken" / "artifacts" / "episodes.csv").read_text()
    assert table == (tmp_path / "unbroken" / "artifacts" / "episodes.csv").read_text()
    lines = list(csv.DictReader(io.StringIO(table)))
    assert list(lines[0]) == ["episode", "step", "frames", "score", "length", "env"]
    assert [int(line["episode"]) for line in lines] == list(range(1, len(lines) + 1))
    assert {line["env"] for line in lines} == {"0", "1", "2"}
    raw = curve(tmp_path / "broken", "score/episode")
    assert [(int(line["step"]), float(line["score"])) for line in lines] == raw != []


def test_pictures_count_windows_and_evaluations_so_that_runs_stand_side_by_side(small: Small, tmp_path: Path) -> None:
    cadence = {"evaluate_steps": 40, "histogram_episodes": 2}
    small(tmp_path, episode_steps=20, **cadence).run(after(70))
    small(tmp_path, episode_steps=20, **cadence).run()
    positions: dict[str, list[int]] = {}
    for _, record in read(tmp_path):
        if isinstance(record, Image):
            positions.setdefault(record.key, []).append(record.step)
    four = [0, 1, 2, 3]
    assert positions == {"score/histogram": four, "score/heatmap": four, "evaluation/histogram": four}
    pictures = tmp_path / "artifacts/images"
    assert b"'training, episodes 3-4'" in (pictures / "score/histogram/1.png").read_bytes()
    assert b"[20, 40, 60, 80], " in (pictures / "score/heatmap/1.png").read_bytes()
    assert b"160, 'steps', (1000.0, 1000000.0))" in (pictures / "score/heatmap/1.png").read_bytes()
    assert b"'evaluation, step 80'" in (pictures / "evaluation/histogram/1.png").read_bytes()


def test_the_description_says_how_the_run_stands_and_what_its_last_evaluation_was(small: Small, tmp_path: Path) -> None:
    def notes() -> list[str]:
        tags = [record.values for _, record in read(tmp_path) if isinstance(record, Tags)]
        return [values[NOTE] for values in tags if NOTE in values]

    trainer = small(tmp_path)
    trainer.recorder.about = "Continue with: x"
    trainer.run(lambda: trainer.counters.steps >= 100)
    assert notes()[0].startswith("**running** at step 0")
    assert all(note.endswith("\n\nContinue with: x") for note in notes())
    assert "**interrupted** at step 100" in notes()[-1]
    trainer.run()
    done = trainer.recorder.done
    mean = done.last_metrics["evaluation/mean"]
    assert "**finished** at step 160" in notes()[-1]
    assert f"| 160 | {mean:,.0f} |" in notes()[-1]
    assert f"The best mean so far is {done.best_mean:,.0f}, at step {done.best_step:,}." in notes()[-1]


@pytest.mark.parametrize(("episode_steps", "short"), [(200, True), (100, True), (80, False)])  # of 160 steps
def test_the_description_says_where_a_training_was_too_short_for_curves(
    small: Small, tmp_path: Path, episode_steps: int, short: bool
) -> None:
    trainer = small(tmp_path, episode_steps=episode_steps)
    trainer.run()
    notes = [record.values[NOTE] for _, record in read(tmp_path) if isinstance(record, Tags) and NOTE in record.values]
    said = ["Too short for a curve of scores" in note for note in notes]
    assert said == [False] * (len(notes) - 1) + [short]


def test_a_line_says_how_the_training_stands(small: Small, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = io.StringIO()
    trainer = small(tmp_path, console=Console(file=told, width=300), evaluate_steps=None)
    monkeypatch.setattr(trainer.recorder.progress, "is_due", lambda: True)
    trainer.run(lambda: trainer.counters.steps == 100)
    lines = [line for line in told.getvalue().splitlines() if line.startswith("episode ")]
    assert "  first episode  epsilon " in lines[0]
    scores = [played.score for played in trainer.recorder.episodes]
    assert len(scores) == 2
    epsilon = trainer.plan.epsilon_at(trainer.counters)
    stands = f"score {scores[-1]:,.0f}  mean of 20 {np.mean(scores):,.0f}  duration 40 (mean of 100 40)"
    assert lines[-1].startswith(
        f"episode 3  {stands}  epsilon {epsilon:.2f}  step 100  updates {trainer.learner.updates}  "
    )
    assert "  phase quick  62.5%  left " in lines[-1]


def test_the_share_of_a_training_is_of_the_steps_until_its_budget_ends(
    small: Small, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = io.StringIO()
    trainer = small(tmp_path, console=Console(file=told, width=300), evaluate_steps=None)
    monkeypatch.setattr(trainer.recorder.progress, "is_due", lambda: True)
    trainer.recorder.begin(trainer.counters, last_step=80)
    trainer.counters.steps = 40
    trainer.recorder.show(trainer.counters)
    assert "  phase quick  50.0%  left " in told.getvalue()


def test_every_number_of_an_evaluation_is_said_at_one_step_and_the_last_ones_is_where_the_run_ended(
    small: Small, tmp_path: Path
) -> None:
    told = io.StringIO()
    trainer = small(tmp_path, console=Console(file=told, width=200), num_envs=7, evaluate_steps=40)
    trainer.run()
    steps = [step for step, _ in curve(tmp_path, "evaluation/mean")]
    assert steps == [40, 80, 120, 161]
    assert trainer.counters.steps == 161
    tables = sorted(path.name for path in (tmp_path / "artifacts" / "evaluation").glob("*.csv"))
    assert tables == [f"{step:09d}.csv" for step in steps]
    assert re.findall(r"step (\d+), 2 episodes evaluated", told.getvalue()) == [*map(str, steps)]
    tags = [record.values for _, record in read(tmp_path) if isinstance(record, Tags)]
    notes = [values[NOTE] for values in tags if NOTE in values]
    assert re.findall(r"\n\| (\d+) \|", notes[-1]) == ["161"]


def test_a_clock_that_steps_back_harms_no_metric(small: Small, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = itertools.count(10**18, -(10**12))
    monkeypatch.setattr("time.time_ns", lambda: next(ticks))
    small(tmp_path).run()
    times = [record.time for _, record in read(tmp_path) if isinstance(record, Metrics)]
    assert times == sorted(times)
    assert min(curve(tmp_path, "throughput/hours"))[1] >= 0


@pytest.mark.parametrize("num_envs", [1, 20])  # with 20, every step of all of them has a point
def test_the_pace_is_known_at_every_point_of_the_curve_whatever_was_evaluated_or_continued(
    small: Small, tmp_path: Path, num_envs: int
) -> None:
    begun = small(tmp_path, num_envs=num_envs, evaluate_steps=20)
    begun.run(lambda: begun.counters.steps >= 80)
    small(tmp_path, num_envs=num_envs, evaluate_steps=20).run()
    speeds = curve(tmp_path, "throughput/steps_per_second")
    assert [step for step, _ in speeds] == list(range(20, 161, 20))
    assert min(speed for _, speed in speeds) > 0


def test_the_state_of_a_training_has_the_keys_that_stored_runs_have(small: Small, tmp_path: Path) -> None:
    trainer = small(tmp_path)
    recorded = {
        *("episodes", "best_mean", "evaluations", "evaluated_at", "owes_evaluation", "best_step", "best_sha256"),
        *("last_report", "last_metrics", "tracker"),
    }
    assert set(trainer.recorder.state_dict()) == recorded
    assert set(trainer.state_dict()) == recorded | {
        *("counters", "learner", "emulators", "stack", "exploration", "sampling", "samplers", "scores", "lengths"),
    }
    assert set(trainer.state_dict()["counters"]) == {"steps", "frames", "episodes", "random", "learn_ticks", "seconds"}


def test_a_recorder_continues_where_another_stood(small: Small, tmp_path: Path) -> None:
    trainer = small(tmp_path)
    trainer.run(lambda: trainer.counters.steps >= 100)
    other = small(tmp_path).recorder
    state, loaded = trainer.recorder.state_dict(), other.state_dict()
    assert np.array_equal(state.pop("episodes"), loaded.pop("episodes"))
    assert state == loaded
    assert other.episodes == trainer.recorder.episodes != []
    assert all(isinstance(played, Played) and isinstance(played.step, int) for played in other.episodes)
    assert other.done == trainer.recorder.done
    assert other.done.best_mean is not None
    assert small(tmp_path / "fresh").recorder.state_dict()["best_mean"] is None
