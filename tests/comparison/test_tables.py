"""The numbers of a comparison against naive oracles, and what its verdict says."""

import csv
import io
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from math import isnan
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

from atlantis_exp.build import build_game
from atlantis_exp.comparison.figures import draw
from atlantis_exp.comparison.page import plain
from atlantis_exp.comparison.published import curves, scores
from atlantis_exp.comparison.tables import Comparison, to_csv
from atlantis_exp.components import facts_of, known
from atlantis_exp.game.emulator import Emulator
from atlantis_exp.game.preprocessing import Preprocessing
from atlantis_exp.game.vector import make_emulators
from atlantis_exp.runs.episodes import EpisodeTable
from atlantis_exp.runs.folder import evaluation_at
from atlantis_exp.training.actor import RandomActor
from atlantis_exp.training.evaluation import evaluate
from tests.comparison.folders import compared_by

Recorded = Callable[..., Path]
GOOD = (
    (5_000.0, 5_200.0, 5_400.0, 5_600.0),
    (5_100.0, 5_300.0, 5_500.0, 5_700.0),
    (5_000.0, 5_100.0, 5_200.0, 5_300.0),
)
BAD = ((3_000.0, 3_300.0, 3_400.0, 3_600.0), (3_100.0, 3_200.0, 3_400.0, 3_700.0), (3_000.0, 3_100.0, 3_500.0, 3_600.0))

ATLANTIS = known("env")["atlantis"]
SOURCES = facts_of(ATLANTIS).sources


@pytest.fixture
def compared(recorded: Recorded, tmp_path: Path) -> Callable[..., Comparison]:
    """Records seeds of a good resnet and a bad cnn, and compares them."""

    def comparison(seeds: int = 3, by: str = "model", **changes: object) -> Comparison:
        for seed in range(seeds):
            recorded("model=resnet", f"seed={seed}", scores=GOOD[seed], **changes)
            recorded("model=cnn", f"seed={seed}", scores=BAD[seed], **changes)
        return compared_by(tmp_path, by)

    return comparison


def test_the_evaluation_of_a_group_is_that_of_all_its_episodes(compared: Callable[..., Comparison]) -> None:
    cnn, resnet = compared().tables["evaluation"]
    pooled = np.concatenate(GOOD)
    assert (resnet["group"], resnet["runs"], resnet["episodes"]) == ("resnet", 3, 12)
    assert (resnet["mean"], resnet["median"]) == (pooled.mean(), np.median(pooled))
    assert (resnet["low"], resnet["high"]) == (5_000, 5_700)
    assert resnet["points_per_frame"] == pytest.approx(pooled.sum() / (12 * 12))
    assert resnet["time_cap_share"] == 0
    assert resnet["human_normalised_mean"] == pytest.approx((pooled.mean() - 12_850) / (29_028.1 - 12_850))
    assert cnn["mean"] == np.mean(BAD)


def played(actor: int, frames: int, seed: int) -> EpisodeTable:
    """Two episodes of the game itself by a player that chooses among the first actions, cut at some frames."""
    make = partial(
        Emulator,
        game=build_game(ATLANTIS),
        preprocessing=Preprocessing(32, (14, 160, 94, 0)),
        frameskip=4,
        sticky=0.25,
        max_frames=frames,
        max_steps=None,
        noop_max=0,
        max_pool=False,
    )
    with make_emulators(make, 2, workers=0) as emulators:
        return evaluate(
            RandomActor(actor), emulators, episodes=2, epsilon=0.0, seed=seed, size=32, lags=range(4)
        ).table()


def with_table(recorded: Recorded, table: EpisodeTable, *overrides: str) -> None:
    """A recorded run whose evaluation is this one."""
    (recorded(*overrides) / "artifacts" / evaluation_at(160)).write_text(table.to_csv())


def test_the_score_is_survival_times_rate_and_the_rate_is_the_sum_of_what_paid(
    recorded: Recorded, tmp_path: Path
) -> None:
    tables = {"cnn": [played(4, 1_200, 0), played(4, 1_200, 1)], "resnet": [played(2, 2_000, 0), played(2, 2_000, 1)]}
    for model, seeds in tables.items():
        for seed, table in enumerate(seeds):
            with_table(recorded, table, f"model={model}", f"seed={seed}")
    comparison = compared_by(tmp_path)
    for row in comparison.tables["why"]:
        episodes = tables[row["group"]]
        scores, frames = (
            [float(x) for table in episodes for x in getattr(table, name)] for name in ("scores", "frames")
        )
        assert row["mean"] == sum(scores) / 4
        assert row["mean"] == pytest.approx(row["frames_mean"] * row["points_per_1000_frames"] / 1_000, rel=1e-12)
        assert row["points_per_1000_frames"] == pytest.approx(1_000 * sum(scores) / sum(frames))
        assert sum(row[source] for source in SOURCES) == pytest.approx(row["points_per_1000_frames"], rel=1e-12)
        for index, source in enumerate(SOURCES):
            points = sum(table.points[:, index].sum() for table in episodes)
            assert row[source] == pytest.approx(1_000 * points / sum(frames))
        assert row["time_cap_share"] == np.mean([table.truncated for table in episodes])
    cnn, resnet = comparison.tables["why"]
    assert cnn["side_vessel"] > 0 == resnet["side_vessel"]  # NOOP and FIRE are the first two actions
    (note,) = (note for note in comparison.notes if "by survival" in note)
    whole, survival, rate = (float(text.replace(",", "")) for text in re.findall(r"[+-][\d,]+", note))
    assert note.startswith("The mean of cnn minus that of resnet is ")
    assert whole == pytest.approx(cnn["mean"] - resnet["mean"], abs=0.51)
    assert survival + rate == pytest.approx(whole, abs=1.51)
    middle = (cnn["points_per_1000_frames"] + resnet["points_per_1000_frames"]) / 2_000
    assert survival == pytest.approx((cnn["frames_mean"] - resnet["frames_mean"]) * middle, abs=0.51)
    assert survival < 0 < rate


@pytest.mark.slow
def test_a_split_that_one_episode_lacks_is_not_known_of_its_group_and_shown_as_empty(
    recorded: Recorded, tmp_path: Path
) -> None:
    table = played(4, 400, 0)
    with_table(recorded, table, "seed=0")
    with_table(recorded, replace(table, points=np.full_like(table.points, np.nan)), "model=resnet")
    comparison = compared_by(tmp_path)
    cnn, resnet = comparison.tables["why"]
    assert np.isfinite([cnn[source] for source in SOURCES]).all()
    assert np.isnan([resnet[source] for source in SOURCES]).all()
    assert resnet["points_per_1000_frames"] == cnn["points_per_1000_frames"] > 0
    assert plain("why", comparison.tables["why"])[2][-5:] == [""] * 5
    svg = draw(comparison)["why"].svg
    assert svg.count("split not recorded") == 1
    assert f"{table.frames.mean():,.0f} frames" in svg


def test_the_score_of_a_group_is_the_mean_of_its_seeds_interquartile_means(compared: Callable[..., Comparison]) -> None:
    comparison = compared()
    iqms = [float(scipy.stats.trim_mean(scores, 0.25)) for scores in GOOD]
    assert [row["score"] for row in comparison.tables["runs"] if row["group"] == "resnet"] == iqms
    assert comparison.tables["scores"][1]["score"] == pytest.approx(np.mean(iqms))


def test_one_group_is_shown_without_a_verdict(compared: Callable[..., Comparison]) -> None:
    comparison = compared(by="optimizer")
    assert comparison.verdict == "There is one group only (adamw), so there is nothing to compare; by=KEY splits it."
    assert comparison.tables["verdict"] == []
    assert any("mixes runs that differ in more than their seed: model.name" in line for line in comparison.caveats)


def test_the_three_fair_views_stand_where_the_shortest_run_ends_and_may_disagree(
    recorded: Recorded, tmp_path: Path
) -> None:
    for seed in range(3):
        fast = ((0, 0.0, 0, 0), (1_000, 1.0, 10, 1_000 + seed))
        slow = ((0, 0.0, 0, 0), (2_000, 8.0, 20, 4_000 + seed))
        recorded("model=cnn", f"seed={seed}", curve=fast, flops=100)
        recorded("model=resnet", f"seed={seed}", curve=slow, flops=1_000)
    comparison = compared_by(tmp_path)
    frames, hours, flops = comparison.tables["views"]
    assert (frames["at"], frames["leader"]) == (1_000, "resnet")
    assert frames["leader_score"] == pytest.approx(2_000.5)  # half way
    assert (hours["at"], hours["leader"], hours["other_score"]) == (1.0, "cnn", pytest.approx(500.125))
    assert (flops["at"], flops["leader"], flops["other_score"]) == (1_000, "cnn", pytest.approx(4_001 * 1_000 / 20_000))


def test_without_flops_that_view_alone_is_left_out(compared: Callable[..., Comparison]) -> None:
    comparison = compared(flops=None)
    assert [view["view"] for view in comparison.tables["views"]] == ["equal frames", "equal hours"]


def test_a_curve_is_the_mean_over_runs_as_far_as_all_of_them_go(recorded: Recorded, tmp_path: Path) -> None:
    recorded("seed=0", curve=((0, 0, 0, 0), (100, 1, 1, 100)))
    recorded("seed=1", curve=((0, 0, 0, 300), (200, 1, 1, 300)))
    tables = compared_by(tmp_path).tables
    rows, seeds = tables["curves"], [row for row in tables["seed_curves"] if row["axis"] == "frames"]
    frames = [row for row in rows if row["axis"] == "frames"]
    assert (frames[0]["x"], frames[-1]["x"]) == (0, 100)
    assert (frames[0]["score"], frames[-1]["score"]) == (150, 200)
    assert np.isnan([frames[-1]["low"], frames[-1]["high"]]).all()  # of two seeds
    assert sorted(row["score"] for row in seeds if row["x"] == 100) == [100, 300]
    assert {row["epsilon"] for row in rows} == {0.5}


def test_runs_of_one_seed_are_one_seed_and_those_of_equal_games_are_not(recorded: Recorded, tmp_path: Path) -> None:
    for seed, sampler, last in ((0, "uniform", 0), (0, "top_half", 200), (1, "uniform", 400), (2, "uniform", 999)):
        scores = (1.0, 3.0 + min(seed, 1))  # seed 2 plays as seed 1
        recorded(f"seed={seed}", f"sampler={sampler}", scores=scores, curve=((0, 0, 0, 0), (100, 1, 1, last)))
    tables = compared_by(tmp_path).tables
    assert tables["scores"][0]["seeds"] == 3
    curve = [row["score"] for row in tables["curves"] if row["axis"] == "frames"]
    assert curve[-1] == (100 + 400 + 999) / 3  # of trainings, which may differ though their last games do not
    assert len({row["run"] for row in tables["episodes"]}) == 4
    assert tables["evaluation"][0]["episodes"] == len(tables["episodes"])
    assert len(tables["runs"]) == 4


def test_the_profile_is_the_share_of_episodes_above_a_score(compared: Callable[..., Comparison]) -> None:
    comparison = compared()
    scores = np.concatenate(BAD)
    rows = [row for row in comparison.tables["profile"] if row["group"] == "cnn"]
    assert len(rows) > 50
    for row in rows:
        assert row["share"] == pytest.approx((scores > row["tau"]).mean())


def test_the_action_ledger_says_who_chose_what(compared: Callable[..., Comparison]) -> None:
    rows = [row for row in compared().tables["actions"] if row["group"] == "cnn"]
    assert {row["action"]: (row["network"], row["random"]) for row in rows} == {
        "NOOP": (0.25, 0),
        "FIRE": (0.25, 0),
        "RIGHTFIRE": (0.25, 0),
        "LEFTFIRE": (0, 0.25),
    }


def test_runs_that_differ_in_more_than_the_question_are_named(recorded: Recorded, tmp_path: Path) -> None:
    recorded("model=cnn", "seed=0")
    recorded("model=cnn", "seed=1", "objective.gamma=0.5")
    recorded("model=resnet", "seed=0", "optimizer.lr=0.5", "env.size=48")
    comparison = compared_by(tmp_path)
    assert any(
        line.startswith("cnn mixes runs") and "objective.gamma (0.99 or 0.5)" in line for line in comparison.caveats
    )
    (between,) = [line for line in comparison.caveats if line.startswith("The groups also differ in")]
    assert "env.size (40 or 48)" in between
    assert "optimizer.lr (0.001 or 0.5)" in between
    assert "model" not in between
    assert "gamma" not in between


def test_the_time_cap_is_named_where_it_decides(compared: Callable[..., Comparison]) -> None:
    comparison = compared(truncated=2)
    assert comparison.tables["evaluation"][0]["time_cap_share"] == 0.5
    assert any("50% of cnn, 50% of resnet" in note for note in comparison.notes)


def test_early_scores_below_random_come_with_the_reason(compared: Callable[..., Comparison]) -> None:
    early = "at 5 M frames published DQN is at 7,000 to 9,000"
    assert any(
        note.startswith(f"Scores below the random player's are normal this early: {early}") for note in compared().notes
    )
    means = [row["mean"] for row in curves(ATLANTIS) if row["name"].startswith("DQN") and row["frames"] == 5e6]
    assert 7_000 < min(means) < max(means) < 9_000


def test_a_late_curve_has_the_published_ones_next_to_it_and_no_excuse(compared: Callable[..., Comparison]) -> None:
    comparison = compared(curve=((0, 0, 0, 0), (12_000_000, 9, 9, 9_000)))
    assert not any("normal this early" in note for note in comparison.notes)
    assert {row["frames"] for row in comparison.tables["published_curves"]} == {1e6 * n for n in range(1, 11)}


def test_what_is_published_has_a_protocol_and_a_source() -> None:
    rows = scores(ATLANTIS)
    published = {row["name"]: row for row in rows}
    assert all(
        row["protocol"] and row["source"] and row["kind"] in ("player", "algorithm") for row in published.values()
    )
    assert published["random player"]["score"] == 12_850
    assert published["GDI-H3"]["score"] == 3_837_300
    assert published["R2D2"]["points_per_frame"] == pytest.approx(15.0, abs=0.05)  # under a cap of 108,000 frames
    assert published["DQN (Nature)"]["points_per_frame"] == pytest.approx(4.76, abs=0.01)  # five minutes
    assert isnan(published["GDI-H3"]["points_per_frame"])  # whose cap nobody knows
    assert len({frozenset(row) for row in rows}) == 1
    assert all(row["source"] and row["seeds"] in (4, 5) for row in curves(ATLANTIS))
    assert all(row["low"] <= row["mean"] <= row["high"] for row in curves(ATLANTIS))


def test_a_table_survives_csv(compared: Callable[..., Comparison]) -> None:
    table = compared().tables["scores"]
    read = list(csv.DictReader(io.StringIO(to_csv(table))))
    assert [float(row["score"]) for row in read] == [row["score"] for row in table]
    assert to_csv([]) == ""
