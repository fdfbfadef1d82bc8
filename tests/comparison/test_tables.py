"""The numbers of a comparison against naive oracles, and what its verdict says."""

import csv
import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

from atlantis_exp.comparison import tables
from atlantis_exp.comparison.gather import gather, group
from atlantis_exp.comparison.tables import Comparison, compare, early_dqn, literature, to_csv

Recorded = Callable[..., Path]
GOOD = (
    (5_000.0, 5_200.0, 5_400.0, 5_600.0),
    (5_100.0, 5_300.0, 5_500.0, 5_700.0),
    (5_000.0, 5_100.0, 5_200.0, 5_300.0),
)
BAD = ((3_000.0, 3_300.0, 3_400.0, 3_600.0), (3_100.0, 3_200.0, 3_400.0, 3_700.0), (3_000.0, 3_100.0, 3_500.0, 3_600.0))


@pytest.fixture
def compared(recorded: Recorded, tmp_path: Path) -> Callable[..., Comparison]:
    """Records seeds of a good resnet and a bad cnn, and compares them."""

    def comparison(seeds: int = 3, by: str = "model", **changes: object) -> Comparison:
        for seed in range(seeds):
            recorded("model=resnet", f"seed={seed}", scores=GOOD[seed], **changes)
            recorded("model=cnn", f"seed={seed}", scores=BAD[seed], **changes)
        gathered = gather(tmp_path)
        return compare(gathered, group(gathered.trainings, [by]), [by], 200, 0)

    return comparison


def test_the_evaluation_of_a_group_is_that_of_all_its_episodes(compared: Callable[..., Comparison]) -> None:
    cnn, resnet = compared().tables["evaluation"]
    pooled = np.concatenate(GOOD)
    assert (resnet["group"], resnet["runs"], resnet["episodes"]) == ("resnet", 3, 12)
    assert resnet["iqm"] == scipy.stats.trim_mean(pooled, 0.25)
    assert (resnet["mean"], resnet["median"]) == (pooled.mean(), np.median(pooled))
    assert (resnet["low"], resnet["high"]) == (5_000, 5_700)
    assert resnet["score_per_1000_steps"] == pytest.approx(1_000 * pooled.sum() / (12 * 4))
    assert resnet["time_cap_share"] == 0
    assert resnet["human_normalised_mean"] == pytest.approx((pooled.mean() - 12_850) / (29_028.1 - 12_850))
    for row in (cnn, resnet):
        for statistic in ("iqm", "mean", "median"):
            assert row[f"{statistic}_low"] <= row[statistic] <= row[f"{statistic}_high"]
            assert row[f"{statistic}_low"] < row[f"{statistic}_high"]


def test_of_very_many_episodes_fewer_bootstrap_samples_are_drawn(
    recorded: Recorded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded(scores=GOOD[0])
    groups = group(gather(tmp_path).trainings, ["model"])
    assert tables.fewer_samples(groups, 2_000) == 2_000
    monkeypatch.setattr(tables, "_MOST_DRAWN", 4 * 300)
    assert (tables.fewer_samples(groups, 2_000), tables.fewer_samples(groups, 100)) == (300, 100)
    monkeypatch.setattr(tables, "_MOST_DRAWN", 4)
    assert tables.fewer_samples(groups, 2_000) == 200


def test_the_verdict_is_the_difference_of_the_runs_iqms_with_welchs_interval(
    compared: Callable[..., Comparison],
) -> None:
    comparison = compared()
    iqms = [[float(scipy.stats.trim_mean(scores, 0.25)) for scores in seeds] for seeds in (GOOD, BAD)]
    theirs = scipy.stats.ttest_ind(*iqms, equal_var=False).confidence_interval(0.95)
    view = comparison.tables["verdict"][0]
    assert (view["leader"], view["other"], view["decided"], view["more_seeds"]) == ("resnet", "cnn", True, 0)
    assert view["difference"] == pytest.approx(np.mean(iqms[0]) - np.mean(iqms[1]))
    assert (view["low"], view["high"]) == pytest.approx((theirs.low, theirs.high))
    assert comparison.verdict.startswith(
        f"resnet plays better than cnn, by {view['difference']:,.0f} points of evaluation IQM "
        f"(95 % interval {theirs.low:,.0f} to {theirs.high:,.0f}, 3 and 3 runs)"
    )
    assert not any("seeds" in note for note in comparison.notes)
    improvement = comparison.tables["improvement"]
    assert [(row["group"], row["over"], row["probability"]) for row in improvement] == [("cnn", "resnet", 0)]


@pytest.mark.parametrize(
    ("seeds", "more"),
    [(1, "at least 2 more seeds each are needed"), (2, "about 1 more seeds each would decide")],
)
def test_under_three_seeds_nothing_is_decided_and_a_note_says_so(
    compared: Callable[..., Comparison], seeds: int, more: str
) -> None:
    comparison = compared(seeds)
    assert comparison.verdict.startswith("Not decided: resnet is ahead of cnn")
    assert more in comparison.verdict
    assert f"cnn has {seeds} of the 3 seeds without which no interval can be trusted." in comparison.notes


def test_a_difference_within_the_noise_is_not_decided_and_says_how_many_seeds_would_do(
    recorded: Recorded, tmp_path: Path
) -> None:
    for seed, (one, other) in enumerate(((900.0, 600.0), (1_200.0, 900.0), (1_500.0, 1_200.0))):
        recorded("model=cnn", f"seed={seed}", scores=(one,) * 4)
        recorded("model=resnet", f"seed={seed}", scores=(other,) * 4)
    gathered = gather(tmp_path)
    comparison = compare(gathered, group(gathered.trainings, ["model"]), ["model"], 200, 0)
    more = comparison.tables["verdict"][0]["more_seeds"]
    assert more > 0
    assert "Not decided: cnn is ahead of resnet by 300 points" in comparison.verdict
    assert f"about {more} more seeds each would decide a difference of this size" in comparison.verdict


def test_equal_groups_are_not_decided_by_any_number_of_seeds(recorded: Recorded, tmp_path: Path) -> None:
    for seed in range(3):
        recorded("model=cnn", f"seed={seed}", scores=(2_000.0,) * 4)
        recorded("model=resnet", f"seed={seed}", scores=(2_000.0,) * 4)
    gathered = gather(tmp_path)
    comparison = compare(gathered, group(gathered.trainings, ["model"]), ["model"], 200, 0)
    assert "too little for any number of seeds" in comparison.verdict
    assert sum("it has collapsed" in note for note in comparison.notes) == 6


def test_one_group_is_shown_without_a_verdict(compared: Callable[..., Comparison]) -> None:
    comparison = compared(by="optimizer")
    assert comparison.verdict == "There is one group only (adamw), so there is nothing to compare; by=KEY splits it."
    assert comparison.tables["verdict"] == comparison.tables["improvement"] == []
    assert any("mixes runs that differ in more than their seed: model.name" in note for note in comparison.notes)


def test_the_three_fair_views_stand_where_the_shortest_run_ends_and_may_disagree(
    recorded: Recorded, tmp_path: Path
) -> None:
    for seed in range(3):
        fast = ((0, 0.0, 0, 0), (1_000, 1.0, 10, 1_000 + seed))
        slow = ((0, 0.0, 0, 0), (2_000, 8.0, 20, 4_000 + seed))
        recorded("model=cnn", f"seed={seed}", curve=fast, flops=100)
        recorded("model=resnet", f"seed={seed}", curve=slow, flops=1_000)
    gathered = gather(tmp_path)
    comparison = compare(gathered, group(gathered.trainings, ["model"]), ["model"], 200, 0)
    _, frames, hours, flops = comparison.tables["verdict"]
    assert (frames["at"], frames["leader"], frames["decided"]) == (1_000, "resnet", True)
    assert frames["leader_score"] == pytest.approx(2_000.5)  # half way
    assert (hours["at"], hours["leader"], hours["other_score"]) == (1.0, "cnn", pytest.approx(500.125))
    assert (flops["at"], flops["leader"], flops["other_score"]) == (1_000, "cnn", pytest.approx(4_001 * 1_000 / 20_000))
    assert "resnet leads at equal frames and cnn leads at equal hours, equal gradient FLOPs" in comparison.verdict


def test_without_flops_that_view_alone_is_left_out_and_named(compared: Callable[..., Comparison]) -> None:
    comparison = compared(flops=None)
    assert [view["view"] for view in comparison.tables["verdict"]] == ["evaluation", "equal frames", "equal hours"]
    assert any(note.startswith("No verdict at equal gradient FLOPs") for note in comparison.notes)


def test_a_curve_is_the_mean_over_runs_as_far_as_all_of_them_go(recorded: Recorded, tmp_path: Path) -> None:
    recorded("seed=0", curve=((0, 0, 0, 0), (100, 1, 1, 100)))
    recorded("seed=1", curve=((0, 0, 0, 300), (200, 1, 1, 300)))
    gathered = gather(tmp_path)
    rows = compare(gathered, group(gathered.trainings, ["model"]), ["model"], 200, 0).tables["curves"]
    frames = [row for row in rows if row["axis"] == "frames"]
    assert (frames[0]["x"], frames[-1]["x"]) == (0, 100)
    assert (frames[0]["score"], frames[-1]["score"]) == (150, 200)
    assert (frames[-1]["low"], frames[-1]["high"]) == (100, 300)
    assert {row["epsilon"] for row in rows} == {0.5}


def test_the_profile_is_the_share_of_episodes_above_a_score(compared: Callable[..., Comparison]) -> None:
    comparison = compared()
    scores = np.concatenate(BAD)
    rows = [row for row in comparison.tables["profile"] if row["group"] == "cnn"]
    assert len(rows) > 50
    for row in rows:
        assert row["share"] == pytest.approx((scores > row["tau"]).mean())
        assert row["low"] <= row["share"] <= row["high"]


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
    gathered = gather(tmp_path)
    comparison = compare(gathered, group(gathered.trainings, ["model"]), ["model"], 200, 0)
    assert any(
        note.startswith("cnn mixes runs") and "objective.gamma (0.99 or 0.5)" in note for note in comparison.notes
    )
    (between,) = [note for note in comparison.notes if note.startswith("The groups also differ in")]
    assert "env.size (40 or 48)" in between
    assert "optimizer.lr (0.001 or 0.5)" in between
    assert "model" not in between
    assert "gamma" not in between


def test_the_time_cap_is_named_where_it_decides(compared: Callable[..., Comparison]) -> None:
    comparison = compared(truncated=2)
    assert comparison.tables["evaluation"][0]["time_cap_share"] == 0.5
    assert any("50% of cnn, 50% of resnet" in note for note in comparison.notes)


def test_early_scores_below_random_come_with_the_reason(compared: Callable[..., Comparison]) -> None:
    assert early_dqn() in compared().notes
    assert "At 5 M frames published DQN scores 7,433 to 8,341, below the random player's 12,850" in early_dqn()


def test_a_late_curve_has_the_published_ones_beside_it_and_no_excuse(compared: Callable[..., Comparison]) -> None:
    comparison = compared(curve=((0, 0, 0, 0), (12_000_000, 9, 9, 9_000)))
    assert early_dqn() not in comparison.notes
    assert {row["frames"] for row in comparison.tables["published_curves"]} == {1e6 * n for n in range(1, 11)}


def test_what_is_published_has_a_protocol_and_a_source() -> None:
    scores = {row["name"]: row for row in literature("scores")}
    assert all(row["protocol"] and row["source"] and row["kind"] in ("player", "algorithm") for row in scores.values())
    assert scores["random player"]["score"] == 12_850
    assert scores["GDI-H3"]["score"] == 3_837_300
    assert all(row["source"] and row["seeds"] == 5 for row in literature("curves"))


def test_a_table_survives_csv(compared: Callable[..., Comparison]) -> None:
    table = compared().tables["evaluation"]
    read = list(csv.DictReader(io.StringIO(to_csv(table))))
    assert [float(row["iqm"]) for row in read] == [row["iqm"] for row in table]
    assert to_csv([]) == ""
