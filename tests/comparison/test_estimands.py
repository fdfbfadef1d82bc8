"""Training scores against naive code, on kept tables, and where a process has a known mean."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from atlantis_exp.comparison.estimands import FEWEST_EPISODES, TrainingEpisodes, by_training, score_of, training_score
from atlantis_exp.comparison.gather import gather
from atlantis_exp.faults import ConfigError
from atlantis_exp.runs.folder import EPISODES, RunFolder

RESULTS = Path(__file__).resolve().parents[2] / "results"
KEPT = sorted((RESULTS / "verdict" / "runs").glob("*-uniform-s*"))


def naive(episodes: TrainingEpisodes, steps: int, num_envs: int, window: float) -> float:
    """Return the same, step by step: each step of each episode has an equal part of its score."""
    points, known, ended = 0.0, 0, 0
    for end, length, score in zip(episodes.ends, episodes.lengths, episodes.scores, strict=True):
        if end > steps * (1 - window):
            ended += 1
            for back in range(int(length)):
                if end - back * num_envs > steps * (1 - window):
                    points += score / length
                    known += 1
    return points / known * steps * window / ended


@pytest.mark.parametrize("run", KEPT[:6], ids=lambda run: run.name)
def test_it_is_what_a_walk_through_every_step_finds(run: Path) -> None:
    episodes = TrainingEpisodes.read(run / "artifacts" / "episodes.csv")
    for window in (0.2, 0.5, 1.0):
        expected = naive(episodes, 1_000_000, 16, window)
        assert training_score(episodes, 1_000_000, 16, window) == pytest.approx(expected, rel=1e-3)


def test_episodes_that_fill_the_window_have_their_mean() -> None:
    ends = np.repeat(np.arange(1, 101) * 40.0, 4)  # four environments, ten steps each
    scores = np.tile([1.0, 2.0, 3.0, 6.0], 100)
    table = TrainingEpisodes(ends, np.full(400, 10.0), scores)
    assert training_score(table, 4_000, 4) == pytest.approx(3)
    assert training_score(table, 4_000, 4, window=0.95) == pytest.approx(3)


def test_what_an_episode_earned_before_the_window_does_not_count() -> None:
    ends, lengths = np.array([900.0, *np.arange(901, 931)]), np.array([150.0, *np.full(30, 1.0)])
    table = TrainingEpisodes(ends, lengths, np.array([300.0, *np.full(30, 2.0)]))  # two points a step, always
    assert training_score(table, 1_000, 1) == pytest.approx(2 * 200 / 31)


def process(rng: np.random.Generator, mean: float, growth: float) -> tuple[TrainingEpisodes, float]:
    """Return 16 environments of 62,500 steps, a point a step, whose mean length grows; and its mean in the window."""
    rows = []
    for env in range(16):
        time = 0.0
        while True:
            life = rng.gamma(4) / 4 * mean  # consumed at the speed of the network there is: integral of (t / T)^-growth
            if growth:
                at = (time / 56_250 + 1e-3) ** (1 - growth) + (1 - growth) * life / 56_250
                end = (at ** (1 / (1 - growth)) - 1e-3) * 56_250
            else:
                end = time + life
            if end > 62_500:
                break
            rows.append((end * 16 + env, end - time, end - time))
            time = end
    true = mean * np.mean((np.linspace(50_000, 62_500, 100) / 56_250) ** growth)
    ends, lengths, scores = (np.array(column, np.float64) for column in zip(*rows, strict=True))
    return TrainingEpisodes(ends, lengths, scores), float(true)


@pytest.mark.parametrize("mean", [1_300, 3_500, 4_500])
@pytest.mark.parametrize("growth", [0.0, 0.7])
def test_it_is_unbiased_where_the_mean_of_the_ended_episodes_lags(mean: float, growth: float) -> None:
    rng, found, ended = np.random.default_rng(0), [], []
    for _ in range(60):
        table, true = process(rng, mean, growth)
        found.append(training_score(table, 1_000_000, 16) / true - 1)
        ended.append(table.scores[table.ends > 800_000].mean() / true - 1)
    assert abs(np.mean(found)) < 0.03
    if growth and mean > 3_000:
        assert np.mean(ended) < np.mean(found) - 0.015


@pytest.mark.parametrize(
    ("folder", "run", "steps"),
    [
        ("rewards", "cnn-uniform-s2-5b86150e39", 1_250_000),  # 5 ended: mean 198,920, its evaluation 860,422
        ("standard", "cnn-uniform-s2-58c6ca5154", 1_250_000),  # 9
        ("longer", "cnn-uniform-s0-20892e8da8", 1_000_000),  # 16, all at once at the cap
    ],
)
def test_games_that_outlast_the_window_are_refused(folder: str, run: str, steps: int) -> None:
    table = TrainingEpisodes.read(RESULTS / folder / "runs" / run / "artifacts" / "episodes.csv")
    with pytest.raises(ValueError, match=rf"episodes ended in the last 20% of {steps:,} steps, and .* needs 30"):
        training_score(table, steps, 16)
    one_short = TrainingEpisodes(np.linspace(900, 930, FEWEST_EPISODES - 1), np.ones(29), np.ones(29))
    with pytest.raises(ValueError, match="29 episodes"):
        training_score(one_short, 1_000, 1)


def test_a_table_that_is_none_is_named(tmp_path: Path) -> None:
    (tmp_path / "episodes.csv").write_text("episode,step,length\n1,2,3\n")
    with pytest.raises(ValueError, match=r"episodes\.csv is not a table of a training's episodes"):
        TrainingEpisodes.read(tmp_path / "episodes.csv")


def test_a_kept_run_has_the_score_of_its_steps_and_environments() -> None:
    folder = RunFolder(KEPT[0])
    table = TrainingEpisodes.read(folder.artifact(EPISODES))
    assert score_of(folder) == training_score(table, 1_000_000, 16)
    assert score_of(folder, 0.5) == training_score(table, 1_000_000, 16, 0.5) != score_of(folder)


@pytest.mark.parametrize("row", ["40,nan,10", "40,1e300,10", "40,5,0", "inf,5,10"])
def test_a_table_with_impossible_numbers_is_refused(row: str, tmp_path: Path) -> None:
    (tmp_path / "episodes.csv").write_text(f"step,score,length\n{row}\n")
    with pytest.raises(ValueError, match=r"it has numbers beyond 1e15 or episodes without a step"):
        TrainingEpisodes.read(tmp_path / "episodes.csv")


def of_kept(tmp_path: Path, names: list[str], folder: str = "verdict") -> Path:
    for name in names:
        shutil.copytree(RESULTS / folder / "runs" / name, tmp_path / "runs" / name)
    return tmp_path


def test_a_run_whose_games_outlast_the_window_is_refused_by_name_and_not_left_out(tmp_path: Path) -> None:
    name = "cnn-uniform-s2-5b86150e39"
    outputs = of_kept(tmp_path, [name], "rewards")
    with pytest.raises(ConfigError, match=rf"^score=training: {name}: 5 episodes ended in the last 20% of 1,250,000"):
        by_training(gather(outputs).trainings, outputs, 0.2)


def test_a_run_without_a_table_of_its_episodes_is_refused_by_name(
    recorded: Callable[..., Path], tmp_path: Path
) -> None:
    name = recorded().name
    with pytest.raises(ConfigError, match=rf"^score=training: {name}: .*episodes\.csv"):
        by_training(gather(tmp_path).trainings, tmp_path, 0.2)


def test_trainings_whose_epsilon_differs_in_the_window_are_refused_by_name(tmp_path: Path) -> None:
    names = [run.name for run in KEPT[:2]]
    outputs = of_kept(tmp_path, names)
    one, other = gather(outputs).trainings
    assert [run.training_score for run in by_training([one, other], outputs, 0.2)] == [
        score_of(RunFolder(outputs / "runs" / name)) for name in names
    ]
    epsilon = other.curve["epsilon"].copy()
    epsilon[other.curve["frames"] < 0.75 * other.curve["frames"][-1]] = 1.0
    before = replace(other, curve={**other.curve, "epsilon": epsilon})
    assert len(by_training([one, before], outputs, 0.2)) == 2  # alike within the window
    with pytest.raises(ConfigError, match=r"epsilon differs in the last 50% of"):
        by_training([one, before], outputs, 0.5)
    within = replace(other, curve={**other.curve, "epsilon": other.curve["epsilon"] + 0.02})
    expected = (
        f"^score=training: epsilon differs in the last 20% .*: 0.05 in {one.name}; 0.07 in {other.name}; score=last"
    )
    with pytest.raises(ConfigError, match=expected):
        by_training([one, within], outputs, 0.2)
    with pytest.raises(ConfigError, match=rf"^score=training: {other.name} has no curve"):
        by_training([one, replace(other, curve={})], outputs, 0.2)
