"""What a comparison is asked, what it answers, and what it remembers of its looks."""

import csv
import io
import itertools
import json
import re
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from atlantis_exp.comparison.account import Account
from atlantis_exp.comparison.choosing import PROTOCOL, group
from atlantis_exp.comparison.decision import Look, mean_interval
from atlantis_exp.comparison.figures import draw
from atlantis_exp.comparison.gather import Gathered, StoredRun, Training
from atlantis_exp.comparison.page import page, plain
from atlantis_exp.comparison.tables import Comparison, compare, to_csv
from atlantis_exp.comparison.verdict import Group, Question, answer, families, group_of, wanted, worse_than_baseline
from atlantis_exp.comparison.words import spent
from atlantis_exp.faults import ConfigError
from atlantis_exp.runs.episodes import EpisodeTable
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.journal import Journal
from atlantis_exp.sessions import comparing
from atlantis_exp.statistics import interquartile_mean

Recorded = Callable[..., Path]
Run = Callable[..., str]

STEADY = (0.0, 30.0, -20.0, 10.0, -30.0, 20.0, 5.0, -15.0, 25.0, -5.0)  # points around a group's score, one a seed


def episodes(score: float, seed: int) -> tuple[float, ...]:
    """Four episodes whose interquartile mean, but not mean, is the score and the seed's share of STEADY."""
    score += STEADY[seed]
    return (score - 400.0 - seed, score - 100.0, score + 100.0, score + 900.0 + seed)


def of(model: str, seed: int, scores: Sequence[float], sampler: str = "uniform", **changes: Any) -> Training:
    """A finished run without its folder."""
    config = {
        "model.name": model,
        "sampler": sampler,
        "seed": seed,
        "env.id": "atlantis",
        "budget.steps": None,
        **{key: 0 for key in PROTOCOL if key != "env.id"},
    }
    size = len(scores)
    frames = np.full(size, 100.0)
    table = EpisodeTable(
        ("NOOP",),
        np.arange(size),
        np.array(scores),
        frames / 4,
        frames,
        np.zeros(size),
        np.ones((size, 1, 2)),
        np.empty((size, 0)),
        (),
    )
    facts: dict[str, Any] = {"tags": {}, "policy": "", **changes}
    science = {key: value for key, value in config.items() if key != "budget.steps"}
    tags = facts.pop("tags")
    return Training(f"{model}-{sampler}-s{seed}", config, tags, science, {}, table, **facts)


def around(model: str, score: float, seeds: Iterable[int] = range(5), **changes: Any) -> list[Training]:
    """Seeds of a model around a score."""
    return [of(model, seed, episodes(score, seed), **changes) for seed in seeds]


def compared(
    runs: Sequence[Training],
    *by: str,
    record: Mapping[str, Sequence[Look]] | None = None,
    now: bool = False,
    **question: Any,
) -> Comparison:
    """What the comparison of some runs by some keys, or by model, says."""
    by = by or ("model",)
    return compare(Gathered(list(runs)), group(runs, by), Question(by, **question), Account(record or {}), now)


def record_of(comparison: Comparison) -> dict[str, list[Look]]:
    """What a comparison leaves to the next one."""
    return {each.family.name: each.decision.looks for each in comparison.answers}


@pytest.fixture
def record_seeds(recorded: Recorded) -> Callable[..., list[Path]]:
    """Writes the folders of seeds of a model around a score; those after the first as copies, which is faster."""

    def record(model: str, score: float, seeds: Iterable[int] = range(5), **tags: str) -> list[Path]:
        first = recorded(f"model={model}", "seed=77", scores=episodes(score, 0))
        folders = []
        for seed in seeds:
            folder = shutil.copytree(first, first.with_name(f"{model}-{score:.0f}-s{seed}"))
            config = json.loads((folder / "config.json").read_text())
            (folder / "config.json").write_text(json.dumps({**config, "seed": seed}))
            (path,) = folder.glob("artifacts/evaluation/*.csv")
            table = replace(EpisodeTable.read(path), scores=np.array(episodes(score, seed)))
            path.write_text(table.to_csv())
            journal = Journal(folder)
            journal.resume()
            journal.tags({key.replace("_", "."): value for key, value in tags.items()})
            journal.flush()
            folders.append(folder)
        shutil.rmtree(first)
        return folders

    return record


@pytest.fixture
def _undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages without figures, which take seconds."""
    monkeypatch.setattr(comparing, "draw", lambda _: {})


@pytest.fixture
def run(command: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Run:
    """Return a function that compares, checks its exit code and returns the printed text on one line."""

    def compared(*words: str, code: int = 0) -> str:
        assert command("compare", f"paths.outputs={tmp_path}", "tracking=none", *words) == code
        shown = capsys.readouterr()
        return " ".join((shown.err if code else shown.out).split())

    return compared


def the_folder(outputs: Path) -> Path:
    (folder,) = (outputs / "comparisons").iterdir()
    return folder


# What is asked, and the one quantity that is decided.


def test_the_verdict_the_tables_the_figure_and_the_page_show_one_quantity() -> None:
    runs = [*around("cnn", 3_000.0), *around("resnet", 5_000.0)]
    comparison = compared(runs, baseline="cnn")
    expected = {
        model: float(np.mean([interquartile_mean(run.episodes.scores) for run in runs if model in run.name]))
        for model in ("cnn", "resnet")
    }
    scores = {row["group"]: row for row in comparison.tables["scores"]}
    assert {name: row["score"] for name, row in scores.items()} == expected
    assert expected != {row["group"]: row["mean"] for row in comparison.tables["evaluation"]}
    difference = expected["resnet"] - expected["cnn"]
    (verdict,) = comparison.tables["verdict"]
    assert (verdict["group"], verdict["other"], verdict["said"]) == ("resnet", "cnn", "better")
    assert verdict["difference"] == pytest.approx(difference)
    assert scores["resnet"]["difference"] == verdict["difference"]
    assert (scores["resnet"]["low"], scores["resnet"]["high"]) == mean_interval(
        [row["score"] for row in comparison.tables["seeds"] if row["group"] == "resnet"]
    )
    figures = draw(comparison)
    assert f"cnn {expected['cnn']:,.0f}, resnet {expected['resnet']:,.0f}" in figures["scores"].alt
    assert f">{expected['resnet']:,.0f}<" in figures["scores"].svg
    text = page(comparison, figures, {})
    assert f"resnet plays better than cnn by {difference:,.0f} points" in comparison.verdict
    assert comparison.verdict in text
    assert f'<td class="number">{expected["cnn"]:,.0f} (' in text
    (row, _) = csv.DictReader(io.StringIO(to_csv(comparison.tables["scores"])))
    assert float(row["score"]) == expected["cnn"]


def test_a_sweep_answers_for_each_key_averaged_over_the_other_and_for_all_groups() -> None:
    runs = [
        run
        for model, sampler, score in product(("cnn", "resnet"), ("uniform", "top_half"), (3_000.0,))
        for run in around(model, score + 2_000 * (model == "resnet") + 8 * (sampler == "uniform"), sampler=sampler)
    ]
    comparison = compared(runs, "model", "sampler")
    model, _, groups = comparison.answers
    assert [each.family.name for each in comparison.answers] == ["model", "sampler", "model,sampler"]
    assert [each.family.plan.error for each in comparison.answers] == [0.05 / 3] * 3
    assert model.family.seeds["cnn"] == {seed: pytest.approx(3_004 + STEADY[seed]) for seed in range(5)}
    (verdict,) = model.decision.verdicts
    assert (verdict.said, verdict.seeds) == ("worse", 5)
    assert verdict.difference == pytest.approx(-2_000)
    assert comparison.verdict.startswith("By model: resnet plays better than cnn by 2,000 points")
    assert comparison.others[0].startswith("By sampler: Not decided: top_half against uniform (difference -8")
    assert len(groups.decision.verdicts) == 6
    assert [verdict.said for verdict in groups.decision.verdicts].count("not decided") == 2
    assert "resnet top_half plays better than cnn top_half and than cnn uniform" in comparison.others[1]
    assert [row["family"] for row in comparison.tables["scores"]] == ["model"] * 2 + ["sampler"] * 2 + [
        "model,sampler"
    ] * 4


def test_unbalanced_groups_and_seeds_are_left_out_of_a_keys_answer_and_named() -> None:
    runs = [
        *around("cnn", 3_000.0, sampler="uniform"),
        *around("cnn", 3_000.0, range(4), sampler="top_half"),
        *around("resnet", 5_000.0, sampler="uniform"),
        *around("resnet", 5_000.0, sampler="top_half"),
        *around("tiny", 1_000.0, sampler="uniform"),
    ]
    comparison = compared(runs, "model", "sampler")
    model, sampler, _ = (each.family for each in comparison.answers)
    assert set(model.groups) == {"cnn", "resnet", "tiny"}
    assert {group.label for group in model.groups["cnn"]} == {"cnn uniform"}
    assert model.left_out == ["cnn top_half", "resnet top_half"]
    assert sampler.left_out == ["tiny uniform"]
    assert list(sampler.seeds["top_half"]) == [0, 1, 2, 3]
    caveats = " ".join(comparison.caveats)
    assert "By model, groups without a counterpart for every value are left out: cnn top_half" in caveats
    assert "By sampler, top_half is averaged without seed 4, which not all of its groups have." in caveats


def test_keys_that_share_no_value_are_not_answered_by_themselves() -> None:
    runs = [*around("cnn", 3_000.0, sampler="uniform"), *around("resnet", 5_000.0, sampler="top_half")]
    comparison = compared(runs, "model", "sampler")
    assert [each.family.name for each in comparison.answers] == ["model,sampler"]
    assert any(line.startswith("model is not answered by itself") for line in comparison.caveats)
    (each,) = comparison.answers
    assert each.family.plan.error == 0.05


def test_a_baseline_is_compared_with_each_other_one_and_the_table_gets_the_differences() -> None:
    runs = [*around("cnn", 3_000.0), *around("resnet", 5_000.0), *around("tiny", 1_000.0)]
    comparison = compared(runs, baseline="cnn")
    assert [(row["group"], row["other"], row["said"]) for row in comparison.tables["verdict"]] == [
        ("resnet", "cnn", "better"),
        ("tiny", "cnn", "worse"),
    ]
    assert "tiny plays worse than cnn by 2,000 points (1," in comparison.verdict
    header, cnn, resnet, tiny = plain("scores", comparison.tables["scores"])
    assert header == ["group", "seeds", "score", "difference", "verdict"]
    assert (cnn[3], resnet[3][:7], tiny[3][:8]) == ("", "2,000 (", "-2,000 (")
    assert plain("scores", compared(runs).tables["scores"])[0] == ["group", "seeds", "score"]


def test_a_baseline_may_be_a_value_of_a_key_or_a_group_and_nothing_else() -> None:
    runs = [
        run for model in ("cnn", "resnet") for s in ("uniform", "top_half") for run in around(model, 9.0, sampler=s)
    ]
    plans = [each.family.plan.baseline for each in compared(runs, "model", "sampler", baseline="uniform").answers]
    assert plans == [None, "uniform", None]
    plans = [each.family.plan.baseline for each in compared(runs, "model", "sampler", baseline="cnn uniform").answers]
    assert plans == [None, None, "cnn uniform"]
    (alone,) = compared(runs[:5] + runs[10:15], "model", "sampler", baseline="cnn").answers
    assert alone.family.plan.baseline == "cnn uniform"
    with pytest.raises(ConfigError, match=r"^baseline=cnm: no such group; did you mean 'cnn'\? \(valid: cnn, cnn top"):
        compared(runs, "model", "sampler", baseline="cnm")
    with pytest.raises(ConfigError, match=r"^baseline=cnn: there is only one group"):
        compared(runs[:5], baseline="cnn")


def test_the_beginning_of_a_commit_is_a_baseline_where_it_is_the_beginning_of_one_only() -> None:
    commits = ("abcd00000000ffff", "abcd11111111ffff", "1234abcd1234ffff")
    runs = [run for commit in commits for run in around("cnn", 9.0, tags={"git.commit": commit})]
    for asked in ("abcd0", commits[0]):
        (each,) = compared(runs, "git.commit", baseline=asked).answers
        assert each.family.plan.baseline == "abcd000000"
    with pytest.raises(ConfigError, match=r"^baseline=abcd: could be any of abcd000000, abcd111111$"):
        compared(runs, "git.commit", baseline="abcd")
    with pytest.raises(ConfigError, match=r"^baseline=123: no such group"):
        compared(runs, "git.commit", baseline="123")


# Looks.


def test_fewer_than_five_seeds_never_decide_not_even_when_asked_to_look_now() -> None:
    runs = [*around("cnn", 3_000.0, range(4)), *around("resnet", 9_000.0)]
    for now in (False, True):
        comparison = compared(runs, now=now)
        assert comparison.verdict == "Not decided: cnn against resnet; next look at 5 seeds (cnn has 4)."
        assert comparison.tables["looks"] == []
    assert "look=now took no look" in comparison.caveats[-1]


def test_looks_are_taken_where_they_are_planned_and_the_same_seeds_charge_nothing_again() -> None:
    level = (0.0, 15.0)
    seeds = 10

    def runs(count: int) -> list[Training]:
        return [
            run
            for model, more in zip(("cnn", "resnet"), level, strict=True)
            for run in around(model, 3_000 + more, range(count))
        ]

    first = compared(runs(5))
    (spent_first,) = (each.decision.spent for each in first.answers)
    assert spent_first == 0.05 / 4
    assert "next look at 10 seeds (there are 5 each)" in first.verdict
    again = compared(runs(5), record=record_of(first))
    assert record_of(again) == record_of(first)
    assert again.verdict == first.verdict

    between = compared(runs(7), record=record_of(first))
    assert record_of(between) == record_of(first)
    assert "difference -15" in between.verdict
    assert "5 seeds each); next look at 10 seeds (there are 7 each)." in between.verdict
    assert "more seeds" not in between.verdict
    assert (
        "Verdicts use the seeds of their looks, scores all existing seeds: cnn has 7, resnet has 7." in between.caveats
    )

    last = compared(runs(seeds), record=record_of(between))
    (each,) = last.answers
    assert [look.size for look in each.decision.looks] == [5, 10]
    assert each.decision.spent == pytest.approx(0.05)
    assert "and this plan has no further look; a difference of" in last.verdict
    assert "would have been found with 80 %." in last.verdict
    assert [(row["look"], row["seeds"]) for row in last.tables["looks"]] == [(1, 5), (2, 10)]
    widths = [row["high"] - row["low"] for row in last.tables["looks"]]
    assert widths[1] < widths[0]


def test_where_a_look_decides_some_pairs_the_others_take_the_next_one_at_once_if_they_have_its_seeds() -> None:
    runs = around("cnn", 1_000.0, range(10)) + around("other", 1_001.0, range(10)) + around("resnet", 9_000.0)
    (each,) = compared(runs).answers
    assert [look.size for look in each.decision.looks] == [5, 10]
    assert each.taken is each.decision.looks[-1]
    assert {verdict.said: verdict.seeds for verdict in each.decision.verdicts} == {"not decided": 10, "worse": 5}


def test_a_look_that_nobody_planned_is_charged_and_said() -> None:
    runs = [*around("cnn", 3_000.0, range(7)), *around("resnet", 3_015.0, range(7))]
    first = compared([run for run in runs if run.config["seed"] < 5])
    comparison = compared(runs, record=record_of(first), now=True)
    (each,) = comparison.answers
    assert [look.size for look in each.decision.looks] == [5, 7]
    charged = 0.05 * (0.49 - 0.25)
    assert each.decision.looks[1].error == pytest.approx(charged)
    assert spent(each) == "looks planned at 5 and 10 seeds; taken: 5, 7; error spent: 2.45% of 5.00%"
    assert comparison.tables["plan"][0]["taken"] == "5 7"


def test_what_would_have_been_found_is_not_said_of_seeds_that_do_not_differ() -> None:
    runs = [of(model, seed, (2_000.0,) * 4) for model in ("cnn", "resnet") for seed in range(5)]
    last = compared(runs, seeds=5).verdict
    assert last.endswith("the detectable difference is unknown, since seeds do not differ.")
    assert "80 %" not in last


def test_a_shorter_plan_than_that_of_the_looks_taken_says_only_that_it_has_no_look_left() -> None:
    runs = [*around("cnn", 3_000.0, range(10)), *around("resnet", 3_015.0, range(10))]
    longer = compared(runs, seeds=20)
    last = compared(runs, seeds=10, record=record_of(longer)).verdict
    assert record_of(longer)["model"][-1].size == 10
    assert last.endswith("10 seeds each), and this plan has no further look.")


def test_a_difference_within_delta_is_a_verdict_too() -> None:
    runs = [*around("cnn", 3_000.0, range(10)), *around("resnet", 3_015.0, range(10))]
    share = compared(runs, delta=0.05, relative=True)
    assert share.verdict.startswith("cnn is as good as resnet: no difference larger than 5 % (-")
    assert compared(runs, delta=200.0).tables["verdict"][0]["said"] == "equivalent"
    assert "larger than 200 points" in compared(runs, delta=200.0).verdict
    assert compared(runs, delta=1.0).tables["verdict"][0]["said"] == "not decided"


def test_the_seeds_that_the_next_look_wants_are_named_group_by_group() -> None:
    groups = [
        Group(("cnn", "uniform"), {0: 1.0, 1: 2.0, 4: 3.0}),
        Group(("cnn", "top_half"), {0: 1.0, 1: 2.0}),
        Group(("resnet", "uniform"), dict.fromkeys(range(5), 1.0)),
    ]
    answers = answer(families(groups[::2], Question(("model", "sampler"))), {})
    assert wanted(answers) == {"cnn uniform": [2, 3]}
    answers = answer(families(groups[:2], Question(("model", "sampler"))), {})
    assert wanted(answers) == {"cnn top_half": [2, 3, 4], "cnn uniform": [2, 3]}
    decided = answer(families(groups[2:], Question(("model",))), {})
    assert wanted(decided) == {}


@pytest.mark.parametrize("shape", ["normal", "bimodal"])
@pytest.mark.thinned(2)
def test_whoever_follows_what_is_said_to_the_end_is_seldom_told_a_difference_that_is_none(shape: str) -> None:
    rng, question, comparisons = np.random.default_rng(0), Question(("model", "sampler")), 400
    labels = list(product(("cnn", "resnet"), ("uniform", "top_half")))
    wrong = 0
    for _ in range(comparisons):
        values = rng.normal(size=(4, 10))
        if shape == "bimodal":
            values = (rng.random((4, 10)) < 0.7) + 0.1 * values
        seeds: dict[str, list[int]] = {" ".join(label): list(range(5)) for label in labels}
        record: dict[str, list[Look]] = {}
        while any(seeds.values()):
            trained = {label: (values[row], sorted(seeds[" ".join(label)])) for row, label in enumerate(labels)}
            groups = [
                Group(label, {seed: float(own[seed]) for seed in there}) for label, (own, there) in trained.items()
            ]
            answers = answer(families(groups, question), record)
            record = {each.family.name: each.decision.looks for each in answers}
            missing = wanted(answers)
            if not missing:
                break
            seeds = {label: there + missing.get(label, []) for label, there in seeds.items()}
        wrong += any(verdict.said != "not decided" for each in answers for verdict in each.decision.verdicts)
    assert wrong / comparisons <= 0.05


@pytest.mark.thinned(2)
def test_seeds_that_collapse_alike_count_like_others() -> None:
    """Half of one group's seeds collapse to equal games; the other group is steady, at the same mean."""
    rng, question, comparisons, wrong = np.random.default_rng(0), Question(("model",)), 150, 0
    for _ in range(comparisons):
        drawn = {
            "cnn": np.where(rng.random(10) < 0.5, 2_000.0, rng.normal(300_000, 20_000, 10)),
            "resnet": rng.normal(151_000, 20_000, 10),
        }
        seeds = {model: list(range(5)) for model in drawn}
        record: dict[str, list[Look]] = {}
        while True:
            runs = {model: [of(model, seed, (drawn[model][seed],) * 4) for seed in seeds[model]] for model in drawn}
            answers = answer(families([group_of(own, ["model.name"]) for own in runs.values()], question), record)
            record = {each.family.name: each.decision.looks for each in answers}
            missing = wanted(answers)
            if not missing:
                break
            seeds = {model: there + missing.get(model, []) for model, there in seeds.items()}
        wrong += answers[0].decision.verdicts[0].said != "not decided"
    assert wrong / comparisons <= 0.12  # 8 % of 300; 75 % where each collapse was made good by a seed


# Caveats of a verdict.


def test_collapsed_policies_and_equal_scores_are_named() -> None:
    held = (2_000.0,) * 4
    runs = [
        *(of("cnn", seed, held, policy="collapsed: FIRE in 100.0% of the network's decisions") for seed in range(3)),
        *around("cnn", 3_000.0, range(3, 5), policy="FIRE in 40.0% of the network's decisions"),
        of("resnet", 0, held),
        *around("resnet", 5_000.0, range(1, 5)),
    ]
    comparison = compared(runs)
    (each,) = comparison.answers
    assert list(each.family.seeds["cnn"]) == [0, 1, 2, 3, 4]
    caveats = " ".join(comparison.caveats)
    assert "3 of 5 runs of cnn collapsed to one action" in caveats
    assert (
        "The same score in every episode: cnn-uniform-s1 as cnn-uniform-s0, cnn-uniform-s2 as cnn-uniform-s0, "
        "resnet-uniform-s0 as cnn-uniform-s0." in caveats
    )
    assert [row["same_as"] for row in comparison.tables["runs"]][:3] == ["", "cnn-uniform-s0", "cnn-uniform-s0"]
    assert comparison.tables["evaluation"][0]["runs"] == 5


def test_runs_that_lost_a_part_of_their_replay_memory_are_named() -> None:
    runs = [*around("cnn", 1_000.0, range(4)), *around("cnn", 1_000.0, [4], tags={"lost": "7 observations"})]
    caveats = compared([*runs, *around("resnet", 5_000.0)]).caveats
    assert "Continued without a damaged part of their replay memory: cnn-uniform-s4." in caveats


def test_runs_of_a_look_that_are_gone_or_score_otherwise_are_named() -> None:
    runs = [*around("cnn", 3_000.0, range(6)), *around("resnet", 5_000.0, range(6))]
    record = {each.family.name: each.decision.looks for each in compared(runs[:5] + runs[6:11]).answers}
    said = "By model, runs of past looks are gone or have new scores, but their verdicts stay: cnn against resnet."
    assert said not in compared(runs, record=record).caveats
    for others in ([of("resnet", 2, (1.0,) * 4)], []):
        comparison = compared([*runs[:8], *others, *runs[9:]], record=record)
        assert comparison.verdict.startswith("resnet plays better")
        assert said in comparison.caveats


def test_seeds_that_fall_into_modes_come_with_survival_and_points_per_frame() -> None:
    runs = [*around("cnn", 5_000.0, range(4)), *around("cnn", 1_000.0, [4, 5]), *around("resnet", 5_000.0, range(6))]
    comparison = compared(runs)
    scores = np.concatenate([run.episodes.scores for run in runs[:6]])
    assert comparison.tables["evaluation"][0]["points_per_frame"] == pytest.approx(scores.mean() / 100)
    assert any(line.startswith("cnn falls into two modes: 67% of its seeds score 5,005") for line in comparison.caveats)
    assert "falls into two modes" in page(comparison, {}, {})


def test_runs_of_different_precisions_devices_or_processors_are_named() -> None:
    runs = [
        *around("cnn", 3_000.0, tags={"precision": "bfloat16", "device": "cpu", "processor": "Fast 2"}),
        *around("resnet", 5_000.0, tags={"precision": "float32", "device": "cpu", "processor": "Slow 1"}),
    ]
    caveats = " ".join(compared(runs).caveats)
    assert "The runs were made in different precisions: bfloat16 in cnn-uniform-s0 and " in caveats
    assert "float32 in resnet-uniform-s0" in caveats
    assert "devices" not in caveats
    assert (
        "on different processors, so equal hours are not equal work: "
        "Fast 2 in cnn-uniform-s0 and 4 more; Slow 1 in resnet-uniform-s0 and 4 more." in caveats
    )


def test_a_run_that_does_not_say_what_made_it_may_differ_from_those_that_do() -> None:
    runs = [*around("cnn", 3_000.0, tags={"processor": "Fast 2"}), *around("resnet", 5_000.0)]
    assert any("equal work: Fast 2 in cnn-uniform-s0 and " in line for line in compared(runs).caveats)
    assert any("; not recorded in resnet-uniform-s0 and " in line for line in compared(runs).caveats)


def test_seeds_that_a_group_has_lost_are_named_next_to_its_verdict() -> None:
    runs = [*around("cnn", 3_000.0), *around("resnet", 5_000.0)]

    def lost(model: str, seed: int) -> StoredRun:
        there = of(model, seed, (0.0,))
        return StoredRun(there.name, there.config, {}, RunFolder(Path(there.name)), None, [])

    gathered = Gathered(runs, lost=[lost("cnn", 5), lost("cnn", 6), lost("resnet", 4), lost("tiny", 0)])
    caveats = compare(gathered, group(runs, ["model"]), Question(["model"])).caveats
    assert [line for line in caveats if " lacks " in line] == [
        "cnn lacks 2 seeds, unfinished or unusable: cnn-uniform-s5, cnn-uniform-s6. If scores are the reason, "
        "the other seeds are not representative.",
        "tiny lacks 1 seed, unfinished or unusable: tiny-uniform-s0. If scores are the reason, the other seeds "
        "are not representative.",
    ]


def test_runs_that_were_not_trained_equally_long_are_named_unless_that_is_the_question() -> None:
    runs = [*around("cnn", 3_000.0), *around("resnet", 5_000.0)]
    assert not any("equally long" in line for line in compared(runs).caveats)
    for run in runs[:5]:
        run.config["budget.steps"] = 4_000
    said = "The runs were not trained equally long: budget.steps=4,000 in cnn-uniform-s0 and "
    assert any(
        line.startswith(said) and "; the whole plan in resnet-uniform-s0 " in line for line in compared(runs).caveats
    )
    assert not any("equally long" in line for line in compared(runs, "model", "budget.steps").caveats)


def test_what_ended_all_runs_is_said_and_what_a_run_took() -> None:
    runs = learned(cnn=1_010.0, resnet=1_000.0)
    for run, flops, hours in zip(runs, 5 * [2e14, 4e14], 5 * [1, 3], strict=True):
        run.config["budget.flops"] = 3e14
        run.curve.update({"flops": np.array([0, flops]), "hours": np.array([0, hours])})
    said = "All runs were trained for budget.flops=3e+14. On average a run took: "
    assert [line for line in compared(runs).notes if line.startswith(said)] == [
        f"{said}cnn 100 frames, 1.80 hours, 2.8e+14 FLOPs; resnet 100 frames, 2.20 hours, 3.2e+14 FLOPs."
    ]
    runs[0].config["budget.flops"] = 2e14
    comparison = compared(runs)
    assert not any("On average" in line for line in comparison.notes)
    assert any(
        "equally long: budget.flops=2e+14 in cnn-uniform-s0; budget.flops=3e+14 " in line for line in comparison.caveats
    )
    for run in runs:
        run.config["budget.flops"] = None
    assert any(line.startswith("All runs were trained for the whole plan. On ") for line in compared(runs).notes)


def test_evaluations_of_unequal_size_are_named() -> None:
    runs = [*around("cnn", 3_000.0), *around("resnet", 5_000.0)]
    assert not any("numbers of episodes" in line for line in compared(runs).caveats)
    runs[0] = of("cnn", 0, (3_000.0,))
    said = "different numbers of episodes: 1 in cnn-uniform-s0; 4 in cnn-uniform-s1 and "
    assert any(said in line for line in compared(runs).caveats)


def learned(**ends: float) -> list[Training]:
    """Five seeds of each network whose training scores end around a value."""

    def curve(end: float) -> dict[str, Any]:
        return {"frames": np.array([0.0, 100.0]), "epsilon": np.zeros(2), "score": np.array([0.0, end])}

    return [
        replace(run, curve=curve(end + STEADY[run.config["seed"]]))
        for model, end in ends.items()
        for run in around(model, 3_000.0)
    ]


def test_who_leads_while_training_is_described() -> None:
    runs = learned(cnn=1_000.0, resnet=2_000.0)
    comparison = compared(runs)
    (view,) = comparison.tables["views"]
    assert (view["leader"], view["difference"]) == ("resnet", pytest.approx(1_000))
    assert view["low"] < 1_000 < view["high"]
    few = compared(runs[:3] + runs[5:8])
    assert all(np.isnan(row["low"]) for row in (*few.tables["views"], *few.tables["curves"]))
    assert len({row["run"] for row in few.tables["seed_curves"]}) == 6
    assert comparison.tables["seed_curves"] == []


# The verb.


@pytest.mark.usefixtures("_undrawn")
def test_a_worse_commit_ends_with_exit_code_1_and_one_line(record_seeds: Callable[..., list[Path]], run: Run) -> None:
    old, new = "0123456789abcdef0123456789abcdef01234567", "fedcba9876543210fedcba9876543210fedcba98"
    record_seeds("cnn", 5_000.0, git_commit=old)
    for folder in record_seeds("cnn", 3_000.0, git_commit=new, git_dirty="true"):
        folder.rename(folder.with_name(f"{folder.name}~1"))
    error = run("by=git.commit", f"baseline={old[:7]}", code=1)
    assert error.startswith(f"atlantis_exp: worse than the baseline {old[:7]}: {new[:10]} by 2,000 points (1,9")
    assert "Traceback" not in error
    assert "0123456789 plays better than fedcba9876 by 2,000 points" in run("by=git.commit")
    assert "fedcba9876 plays better" not in run("by=git.commit", f"baseline={new}")
    for other in ("abcdef", "1234567", "12345e7", "0012"):  # of which Hydra would make numbers
        assert f"baseline={other}: no such group" in run("by=git.commit", f"baseline={other}", code=2)


@pytest.mark.usefixtures("_undrawn")
def test_runs_that_were_asked_before_go_on_with_their_looks_and_are_told_of_other_questions(
    record_seeds: Callable[..., list[Path]], run: Run, tmp_path: Path
) -> None:
    for model, score in (("cnn", 3_000.0), ("resnet", 3_015.0), ("resnet_fast", 9_000.0)):
        first, *_ = record_seeds(model, score)
    assert "about these runs" not in run("runs=cnn,resnet-", "seeds=5")
    shown = run("runs=resnet-,cnn", "seeds=20")
    assert "By model, this continues the looks of cnn-vs-resnet-" in shown
    assert "5.00% of 5.00%" in shown
    assert "1 other question about these runs spent 5.00% of error;" in (whole := run())
    shutil.rmtree(first)
    assert f"Compared before, and gone or left out now: {first.name}." in run()
    assert "which has 3 pairs in all" in run("runs=cnn,resnet_fast")
    assert "cannot be read" not in whole
    broken = next((tmp_path / "comparisons").glob("cnn-vs-resnet-vs-*")) / "looks.json"
    for name, before, after in (
        ("config.json", '"error": 0.05', '"error": 0.0'),
        ("config.json", '"groups": [', '"groups": [[], '),
        ("looks.json", '"seeds": {', '"seeds": {}, "of": {'),
        ("looks.json", '"error": 0', '"error": 1e308, "of": 0'),
    ):
        sound = (broken.parent / name).read_text()
        (broken.parent / name).write_text(sound.replace(before, after))
        assert before in sound
        assert f"cannot be read: {broken.parent.name}." in run("runs=cnn,resnet-")
        (broken.parent / name).write_text(sound)
    broken.write_text("{}"[:1])
    assert f"cannot be read: {broken.parent.name}." in run("runs=cnn,resnet-")
    assert run(code=1).startswith(f"atlantis_exp: {broken} is not a record")


OLD, NEW = "0123456789abcdef0123456789abcdef01234567", "fedcba9876543210fedcba9876543210fedcba98"


def worse(scores: Mapping[tuple[str, str], float], **question: Any) -> list[str]:
    """What is worse than the baseline, of five seeds of each commit and model."""
    runs = [
        run for (commit, model), score in scores.items() for run in around(model, score, tags={"git.commit": commit})
    ]
    by = ("git.commit", "model") if len({model for _, model in scores}) > 1 else ("git.commit",)
    return worse_than_baseline(compared(runs, *by, **question).answers, by)


def test_another_network_of_the_baselines_commit_is_not_a_worse_commit() -> None:
    scores = {(commit, model): score for commit in (OLD, NEW) for model, score in (("cnn", 5e3), ("resnet", 3e3))}
    assert worse(scores, baseline=f"{OLD[:10]} cnn") == []


def test_a_commit_that_makes_one_network_worse_is_worse_also_where_another_network_gains() -> None:
    scores = {(OLD, "cnn"): 3e3, (NEW, "cnn"): 6e3, (OLD, "resnet"): 5e3, (NEW, "resnet"): 3e3}
    (line,) = worse(scores, baseline=OLD)
    assert re.fullmatch(rf"{NEW[:10]} resnet by 2,000 points \(1,9\d\d to 2,0\d\d, 5 seeds each\)", line)


def test_a_commit_is_worse_whether_the_baseline_comes_first_by_name_or_not_and_not_for_being_better() -> None:
    for old, new in ((OLD, NEW), (NEW, OLD)):
        (line,) = worse({(old, "cnn"): 5e3, (new, "cnn"): 3e3}, baseline=old)
        assert re.fullmatch(rf"{new[:10]} by 2,000 points \(1,9\d\d to 2,0\d\d, 5 seeds each\)", line)
        assert worse({(old, "cnn"): 3e3, (new, "cnn"): 5e3}, baseline=old) == []
        assert worse({(old, "cnn"): 3e3, (new, "cnn"): 3e3}, baseline=old) == []
        assert worse({(old, "cnn"): 5e3, (new, "cnn"): 3e3}) == []  # no baseline


@pytest.mark.usefixtures("_undrawn")
def test_a_question_in_another_order_is_the_same_comparison(
    record_seeds: Callable[..., list[Path]], run: Run, tmp_path: Path
) -> None:
    record_seeds("cnn", 5_000.0)
    record_seeds("resnet", 3_000.0)
    run("by=model", "runs=cnn,resnet", "where=env.stack=4,objective=dqn", "baseline=cnn")
    spent = (the_folder(tmp_path) / "looks.json").read_bytes()
    run("by=model.name,model", "runs=resnet,cnn,resnet", "where=objective=dqn,env.stack=4", "baseline=cnn")
    assert (the_folder(tmp_path) / "looks.json").read_bytes() == spent


@pytest.mark.usefixtures("_undrawn")
def test_keys_in_another_order_are_the_same_comparison(
    record_seeds: Callable[..., list[Path]], run: Run, tmp_path: Path
) -> None:
    for model, score in (("cnn", 5_000.0), ("resnet", 3_000.0)):
        for device, less in (("cpu", 0.0), ("cuda", 1_000.0)):
            record_seeds(model, score - less, device=device)
    sentence = "By device: cpu plays better than cuda by 1,000 points"
    assert sentence in run("by=model,device")
    spent = (the_folder(tmp_path) / "looks.json").read_bytes()
    assert sentence in run("by=device,model")
    assert (the_folder(tmp_path) / "looks.json").read_bytes() == spent


@pytest.mark.usefixtures("_undrawn")
def test_groups_may_have_names_that_are_no_names_of_files(
    record_seeds: Callable[..., list[Path]], run: Run, tmp_path: Path
) -> None:
    for device, score in (("../a", 5e3), ("./a", 4e3), ("\u00fc", 3e3)):
        record_seeds("cnn", score, device=device)
    assert "../a plays better than ./a by 1,000 points" in run("by=device")
    assert the_folder(tmp_path).name.startswith("a-vs-.-a-vs-")


@pytest.mark.usefixtures("_undrawn")
def test_a_baseline_is_named_as_the_tables_name_it(record_seeds: Callable[..., list[Path]], run: Run) -> None:
    for alpha, score in ((0.4, 5_000.0), (0.6, 3_000.0)):
        for folder in record_seeds("cnn", score):
            config = json.loads((folder / "config.json").read_text())
            config["samplers"]["prioritized"]["alpha"] = alpha
            (folder / "config.json").write_text(json.dumps(config))
    said = run("by=samplers.prioritized.alpha", "baseline=alpha=0.4")
    assert "alpha=0.6 plays worse than alpha=0.4 by 2,000 points" in said
    assert "alpha=0.6 plays worse than alpha=0.4" in run("by=samplers.prioritized.alpha", "baseline=0.4")


@pytest.mark.usefixtures("_undrawn")
def test_a_baseline_that_is_none_or_several_is_refused(record_seeds: Callable[..., list[Path]], run: Run) -> None:
    for lr, eps in itertools.product((0.001, 0.002), repeat=2):
        for folder in record_seeds("cnn", 1e6 * lr + 1e5 * eps):
            config = json.loads((folder / "config.json").read_text())
            config["optimizer"] |= {"lr": lr, "eps": eps}
            (folder / "config.json").write_text(json.dumps(config))
    assert run("by=optimizer.lr", "baseline=", code=2).startswith("atlantis_exp: baseline=: no such group; ")
    error = run("by=optimizer.lr,optimizer.eps", "baseline=0.001", code=2)
    assert error == "atlantis_exp: baseline=0.001: could be any of eps=0.001, lr=0.001"


@pytest.mark.usefixtures("_undrawn")
def test_runs_are_told_apart_by_the_device_that_auto_has_become(
    record_seeds: Callable[..., list[Path]], run: Run
) -> None:
    for device, score in (("cpu", 5_000.0), ("cuda", 3_000.0)):
        record_seeds("cnn", score, device=device)
    assert "cpu plays better than cuda by 2,000 points" in run("by=device")


@pytest.mark.parametrize(
    ("word", "line"),
    [
        ("baseline=cnm", "baseline=cnm: there is only one group"),
        ("delta=-5%", "delta=-5%: write a share of a score, as in delta=5%, or points, as in delta=500"),
        ("delta=0", "delta=0: write"),
        ("runs=cnn,resnt", "runs=resnt: no such run under "),
        ("where=env.crop=[1,2,3,4],model=cnn", "no finished training under "),
        ("seeds=4", "seeds=4: should be greater than or equal to 5"),
        ("error=1", "error=1: should be less than 1"),
        ("look=later", "look=later: no such choice; no valid choice is near (valid: due, now)"),
    ],
)
def test_a_question_that_makes_no_sense_is_refused_in_one_line(
    recorded: Recorded, run: Run, word: str, line: str
) -> None:
    recorded()
    assert run(word, code=2).startswith(f"atlantis_exp: {line}")


def test_a_verdict_says_its_condition_and_its_size_where_a_look_found_it() -> None:
    found = compared(around("a", 1_000, range(10)) + around("b", 950, range(10)))
    (line,) = (note for note in found.caveats if "collapsed" in note)
    assert line.startswith("a against b: ")
    assert re.search(r"the corrected estimate is (4\d|50) points\.", line)
    assert "would not hold if 5% of the seeds of a collapsed" in line
    assert re.search(r"1\.0 times as much .* cannot exclude up to (26|45)%", line)
    assert not [note for note in compared(around("a", 1_000) + around("b", 1_000)).caveats if "collapsed" in note]
    steady, steadier = (
        [of(name, seed, (score,) * 4) for seed in range(10)] for name, score in (("c", 5.0), ("d", 9.0))
    )
    for others, said in (
        (around("a", 1_000, range(10)), "here those of one group do not vary"),
        (steadier, "here 1.0"),
    ):
        assert any(said in note for note in compared([*steady, *others]).caveats)


def test_under_the_verdict_stand_its_looks_its_error_and_the_length_of_training() -> None:
    runs = [*around("a", 1_000), *around("b", 950)]
    curve = {key: np.array([0.0, 4e6]) for key in ("frames", "hours", "epsilon", "score")}
    lines = [
        compared([replace(run, curve=curve) for run in runs], error=error).caveats[0] for error in (Question.error, 0.9)
    ]
    for line, error in zip(lines, ("1.25% of 5.00%", "22.50% of 90.00%"), strict=True):
        assert line.startswith("By model: looks planned at 5 and 10 seeds; taken: 5; error spent: ")
        assert line.endswith(f"{error}; trained for up to 4,000,000 frames.")


def test_of_several_groups_those_that_may_be_best_are_named_where_some_cannot_be() -> None:
    runs = [*around("a", 1_000), *around("b", 1_003), *around("c", 100)]
    assert "By model, with 95% the best is one of a, b." in compared(runs).caveats
    for others in (runs[:10] + around("c", 1_001), runs[5:], runs[:5]):
        assert not [line for line in compared(others).caveats if "the best is one of" in line]
    assert not [line for line in compared(runs, baseline="a").caveats if "the best is one of" in line]


def test_an_open_pair_says_how_often_a_seed_wins_and_the_seeds_that_such_a_difference_takes() -> None:
    (line,) = (line for line in compared([*around("a", 1_000), *around("b", 1_015)]).caveats if "A seed of" in line)
    beats = r"A seed of b beats one of a with (\d+)% \((\d+)% to (\d+)%\)"
    found = re.match(rf"{beats}; a difference of this size takes (\d+) seeds each to be found with 80 %\.$", line)
    assert found
    share, low, high, seeds = map(int, found.groups())
    assert share > 50
    assert low < share < high
    assert 20 < seeds < 60  # 0.61 of a standard deviation
    decided = compared([*around("a", 1_000), *around("b", 1_915)]).caveats
    assert any(re.match(rf"{beats}\.$", line) for line in decided)


def test_an_open_pair_says_which_group_is_worse_by_at_most_delta() -> None:
    runs = [*around("a", 1_000), *around("b", 1_040)]

    def said(**question: Any) -> list[str]:
        caveats = compared(runs, error=0.01, **question).caveats
        return [part for line in caveats for part in line.rstrip(".").split("; ") if part.endswith(" worse")]

    assert said() == []
    assert said(delta=60.0) == ["b is at most 60 points worse"]
    assert said(delta=0.06, relative=True) == ["b is at most 6 % worse"]
    assert said(delta=0.06, relative=True, baseline="b") == ["b is at most 6 % worse"]
    (verdict,) = compared(runs, error=0.01, baseline="b").tables["verdict"]
    assert said(delta=verdict["high"] / 1_028, relative=True, baseline="b")  # b's mean is 1,038, both's 1,018
    assert said(delta=5.0) == []
    assert said(delta=0.005, relative=True) == []


def test_a_seed_that_one_group_lacks_below_its_others_is_named() -> None:
    runs = [*around("a", 1_000, (0, 1, 3, 4, 5)), *around("b", 1_000, range(8))]
    (line,) = (line for line in compared(runs).caveats if " lacks seed " in line)
    assert line.startswith("a lacks seed 2, which others have.")


def test_a_seed_that_one_group_lacks_is_named_beside_a_run_of_that_seed_that_another_has_lost() -> None:
    runs = [*around("a", 1_000, (0, 1, 3, 4, 5)), *around("b", 1_000, range(8))]
    there = of("c", 2, (0.0,))
    gathered = Gathered(runs, lost=[StoredRun(there.name, there.config, {}, RunFolder(Path("c")), None, [])])
    caveats = compare(gathered, group(runs, ["model"]), Question(["model"])).caveats
    assert [line.partition(",")[0] for line in caveats if " lacks " in line] == ["c lacks 1 seed", "a lacks seed 2"]
