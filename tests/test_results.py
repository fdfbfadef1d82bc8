"""The numbers of the pages are those of the kept runs, tables and cards."""

import csv
import json
import re
import runpy
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from atlantis_exp.comparison.published import curves
from atlantis_exp.components import game_of
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.journal import Journal, Metrics
from atlantis_exp.sessions.cards import read_card
from benchmarks.schedule import PLAYERS, bombers, most_points
from results import publish
from results.publish import KEPT, LAB, RESULTS, games_at, of_the_verdict, to_a_power

REPOSITORY = Path(__file__).resolve().parents[1]
RUNS = [run for runs in KEPT.values() for run in runs]
THOUSANDS = re.compile(r"\d{1,3}(?:,\d{3})+")
PAGES = ("README.md", "docs/results.md", "docs/reproduction.md")
OUTSIDE = {  # not scores, or not of kept runs
    *("8,053", "25,240", "62,500", "12,000", "64,758", "1,000", "10,000", "20,000", "27,000", "300,000"),  # the report
    *("29,028", "20,873", "17,804", "12,850", "2,000"),  # a human tester, random players, one action held
}


def text_of(page: str) -> str:
    """Return a page as one line."""
    return " ".join((REPOSITORY / page).read_text().split())


@pytest.mark.parametrize("run", RUNS, ids=lambda run: run.name)
def test_a_kept_run_is_still_the_run_of_its_config(run: RunFolder) -> None:
    assert run.trained_config.run_name() == run.name  # else `decide` would train it again
    assert len(games_at(run).scores) == 100


def test_every_published_number_is_that_of_the_kept_files_and_is_on_its_page() -> None:
    numbers = publish.numbers()
    assert json.loads((RESULTS / "numbers.json").read_text()) == numbers
    assert len(numbers[LAB]) > 180
    for page, published in numbers.items():
        text = text_of(page)
        assert [number for number in published if number not in text] == []


@pytest.mark.parametrize("page", ["docs/results.md", "docs/reproduction.md"])
def test_a_page_has_the_tables_that_the_kept_files_give(page: str) -> None:
    text = (REPOSITORY / page).read_text()
    assert "<!-- end -->" in text
    assert publish.with_tables(text, publish.tables()) == text


@pytest.mark.parametrize("page", PAGES)
def test_a_page_has_no_score_that_the_kept_files_lack(page: str) -> None:
    known = " ".join([*publish.tables().values(), *(each for of in publish.numbers().values() for each in of)])
    with (REPOSITORY / "docs/data/ladder.csv").open() as file:
        ladder = {f"{np.mean([*map(float, row['evaluation'].split())]):,.0f}" for row in csv.DictReader(file)}
    peers = {f"{row[end]:,.0f}" for row in curves(game_of("Atlantis-v0")) for end in ("low", "high")}
    known_numbers = {*THOUSANDS.findall(known)} | ladder | peers | OUTSIDE
    prose = re.sub(r"`.*?`|^    .*$", "", (REPOSITORY / page).read_text(), flags=re.MULTILINE)  # without commands
    assert {*THOUSANDS.findall(prose)} - known_numbers == set()


def test_what_the_answers_rank_is_ranked_so_by_the_kept_runs() -> None:
    means = {
        name: [games_at(run).scores.mean() for run in runs]
        for name, runs in {
            "cnn": of_the_verdict("cnn").values(),
            "resnet_fast": of_the_verdict("resnet_fast").values(),
            "report": [run for run in KEPT["reproduction"] if run.name.startswith("cnn")],
            "report_resnet": [run for run in KEPT["reproduction"] if run.name.startswith("resnet")],
            "in_the_reports_game": [run for run in KEPT["rewards"] if run.trained_config.env.id == "Atlantis-v0"],
            "power": [run for run in to_a_power("rewards") if run.trained_config.objective.gamma == 0.99],
            "gaps": [run for run in KEPT["rewards"] if run.trained_config.env.stack != 4],
            "longer_discount": [run for run in to_a_power("rewards") if run.trained_config.objective.gamma == 0.997],
        }.items()
    }
    assert [len(scores) for scores in means.values()] == [10, 10, 3, 1, 3, 3, 1, 1]
    assert np.mean(means["cnn"]) > np.mean(means["resnet_fast"])
    assert max(means["report"]) < publish.RANDOM
    assert means["report_resnet"][0] < min(means["report"])
    assert max(means["in_the_reports_game"]) < min(means["cnn"])
    clipped = [games.scores.mean() for games in publish.in_the_fields_game()]
    assert min(clipped) < min(means["power"]) < max(clipped)
    assert min(games.scores.mean() for games in publish.with_layer_normalization()) > max(means["power"])
    assert max(means["gaps"][0], means["longer_discount"][0]) < min(means["power"])


def test_the_best_player_is_the_last_of_its_training_and_begins_with_the_one_before() -> None:
    _, run = sorted(to_a_power("longer"), key=lambda each: each.trained_config.training.weights or "")
    config = run.trained_config
    before, card = (read_card(publish.PRETRAINED / name)[0] for name in ("cnn_standard", "cnn_annealed"))
    assert config.training.weights == f"pretrained/cnn_standard@{before.sha256[:16]}"
    assert (card.run, card.step) == (run.name, config.budget.steps)
    assert (config.lr_schedule.name, config.replay.capacity) == ("linear", config.budget.steps)


def test_the_notebook_has_what_the_greedy_look_ahead_reached() -> None:
    kept = json.loads((RESULTS / "oracle.json").read_text())
    rates = (f"{kept['points_a_frame']:.2f}", f"{kept['bonus_a_frame']:.2f}", f"{kept['hits_a_thousand_frames']:.1f}")
    lanes = ", ".join(f"{100 * share:.0f} %" for share in kept["share_of_steps_in_lane"])
    empty = f"{100 * kept['share_of_steps_without_a_ship']:.0f} %"
    assert f"| greedy look-ahead | {' | '.join((*rates, lanes, empty))} |" in text_of(LAB)
    (lower, median, upper), bomber = (kept["frames_to_the_next_hit"][f"side_{ship}"] for ship in ("vessel", "bomber"))
    told = f"are {median:.0f} frames (median, quartiles {lower:.0f} and {upper:.0f}), from a bomber hit by one"
    assert f"{told} {bomber[1]:.0f}." in text_of(LAB)


@pytest.mark.slow
def test_the_notebook_has_the_points_that_the_ships_allow() -> None:
    draws = bombers(108_000)
    for gaps in PLAYERS.values():
        points = most_points(draws, gaps)
        assert f"| {points:,.0f} | {points / 108_000:.2f} |" in text_of(LAB)


def test_a_training_on_another_device_began_like_the_kept_one() -> None:
    with (REPOSITORY / "docs/data/top_half_on_a_gpu.csv").open() as file:
        printed = [row for row in csv.DictReader(file) if row["kind"] == "training" and row["seed"] == "4"]
    run = of_the_verdict("resnet_fast", "top_half")[4]
    assert {float(row["mean"]) for row in printed[:3]} <= {*publish.metrics_of(run, "score/mean_20")}


@pytest.mark.slow
def test_what_is_kept_compares_as_it_did_and_names_no_place(
    recorded: Callable[..., Path], command: Callable[..., int], tmp_path: Path
) -> None:
    for seed in range(5):
        for model, score in (("cnn", 1_000.0), ("resnet", 9_000.0)):
            recorded(f"model={model}", f"seed={seed}", scores=(score + seed, score + 3 * seed))
    (tmp_path / "runs" / "begun").mkdir()
    for begun in ("comparisons", "decisions"):
        (tmp_path / begun / "begun").mkdir(parents=True)
    (tmp_path / "decisions" / "begun" / "config.json").write_text("{}")
    kept = tmp_path / "kept"

    def compared(outputs: Path) -> tuple[dict[str, str], bytes]:
        assert command("compare", "by=model", "tracking=none", f"paths.outputs={outputs}") == 0
        (page,) = outputs.glob("comparisons/cnn-*")
        tables = {path.name: path.read_text() for path in page.glob("artifacts/tables/*.csv")}
        return tables, (page / "looks.json").read_bytes()

    tables, looks = compared(tmp_path)
    runpy.run_path(str(RESULTS / "keep_runs.py"))["main"](tmp_path, kept)
    (page,) = kept.glob("comparisons/*")
    assert (page / "looks.json").read_bytes() == looks
    assert len(tables["looks.csv"].splitlines()) == 2  # the first look, which is not taken again
    files = [path for path in kept.rglob("*") if path.is_file()]
    assert {path.suffix for path in files} == {".json", ".jsonl", ".csv"}
    assert not [path for path in files if bytes(tmp_path) in path.read_bytes()]

    again, looks_again = compared(kept)
    assert looks_again == looks
    assert again.keys() == tables.keys()
    assert [name for name in tables if tables[name] != again[name]] == ["skipped.csv"]


def test_an_evaluation_is_kept_too(tmp_path: Path) -> None:
    folder = tmp_path / "evaluations" / "again"
    journal = Journal(folder)
    journal.artifact("evaluation/episodes.csv", b"score")
    journal.finish()
    for name in ("config.json", "result.json"):
        (folder / name).write_text("{}")
    runpy.run_path(str(RESULTS / "keep_runs.py"))["main"](tmp_path, tmp_path / "kept")
    assert (tmp_path / "kept/evaluations/again/artifacts/evaluation/episodes.csv").read_bytes() == b"score"


def test_what_has_been_kept_is_kept_as_it_is(tmp_path: Path) -> None:
    runpy.run_path(str(RESULTS / "keep_runs.py"))["main"](RESULTS / "longer", tmp_path)
    kept, again = (
        {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        for folder in (RESULTS / "longer" / "runs", tmp_path / "runs")
    )
    assert kept
    assert again == kept


def test_a_kept_journal_names_no_file_that_was_left_out() -> None:
    journals = [*RESULTS.glob("*/*/*/journal.jsonl")]
    for journal in journals:
        records = map(json.loads, journal.read_bytes().splitlines())
        paths = [record["path"] for record in records if record["kind"] in ("artifact", "image", "model")]
        assert all((journal.parent / "artifacts" / path).exists() for path in paths), journal
    assert len(journals) > 40


def test_a_kept_curve_has_a_point_every_5000_steps_and_its_whole_end() -> None:
    points = [
        record.step
        for record in of_the_verdict("cnn")[2].records()
        if isinstance(record, Metrics) and "throughput/hours" in record.values
    ]
    assert points == [1_000, *range(5_000, 990_001, 5_000), *range(991_000, 1_000_001, 1_000)]


@pytest.mark.parametrize(
    ("question", "looks"),
    [
        ("by=model runs=decide-7cfff86226", ("01234", "56789")),
        pytest.param("by=model runs=decide-4ec5bdb9f5", ("0123456789",), marks=pytest.mark.slow),
        pytest.param("by=sampler runs=decide-2e9cf34c18", ("0123456789",), marks=pytest.mark.slow),
        pytest.param("by=sampler runs=decide-c9c6a6ffea", ("0123456789",), marks=pytest.mark.slow),
    ],
)
def test_a_question_asked_anew_of_the_kept_runs_has_the_kept_answer(
    question: str, looks: tuple[str, ...], command: Callable[..., int], tmp_path: Path
) -> None:
    question += " seeds=10 at_epsilon=0.05"
    assert f"compare {question}" in text_of("docs/results.md")
    shutil.copytree(RESULTS / "verdict" / "decisions", tmp_path / "decisions")
    for seeds in looks:  # the first before the later seeds are there
        for run in (RESULTS / "verdict" / "runs").glob(f"*-s[{seeds}]-*"):
            shutil.copytree(run, tmp_path / "runs" / run.name)
        assert command("compare", *question.split(), "tracking=none", f"paths.outputs={tmp_path}") == 0
    (made,) = tmp_path.glob("comparisons/*")
    kept = RESULTS / "verdict" / "comparisons" / made.name
    assert (made / "looks.json").read_text() == (kept / "looks.json").read_text()
    for name in ("verdict", "views", "runs", "looks"):
        table = f"artifacts/tables/{name}.csv"
        assert (made / table).read_text() == (kept / table).read_text()


def test_the_verdict_of_the_readme_is_the_one_that_is_printed(
    command: Callable[..., int], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    shutil.copytree(RESULTS / "verdict", tmp_path, dirs_exist_ok=True)
    asked = ("by=model", "runs=decide-7cfff86226", "seeds=10", "at_epsilon=0.05", "tracking=none")
    assert command("compare", *asked, f"paths.outputs={tmp_path}") == 0
    (shown,) = re.findall(
        r"^    - (By model: .*)\n    \.\.\.\n\n    (.*)$", (REPOSITORY / "README.md").read_text(), re.MULTILINE
    )
    printed = " ".join(capsys.readouterr().out.split())
    assert all(line in printed for line in shown)
