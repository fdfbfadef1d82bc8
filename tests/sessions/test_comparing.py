"""The verb compare, from the command line to the page and the store."""

import csv
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mlflow
import pytest

from atlantis_exp.commands.compare import VERB
from atlantis_exp.comparison.estimands import score_of
from atlantis_exp.config import Config
from atlantis_exp.documents import Compared
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.journal import Metrics
from atlantis_exp.sessions import comparing
from atlantis_exp.sessions.job import Job
from atlantis_exp.sessions.training import train

Recorded = Callable[..., Path]
KEPT = Path(__file__).parents[2] / "results" / "verdict"
DECISION = "decide-7cfff86226"  # cnn against resnet_fast, ten seeds each
LOOKS = json.loads((KEPT / "comparisons" / "cnn-vs-resnet-fast-e09e14bb20" / "looks.json").read_text())


def test_a_comparison_is_a_page_figures_and_tables_in_a_folder_and_in_the_store(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed in range(5):
        recorded("model=cnn", f"seed={seed}", scores=(1_000.0 + seed, 1_200.0))
        recorded("model=resnet", f"seed={seed}", scores=(9_000.0 + seed, 9_200.0))
    (tmp_path / "runs" / "foreign").mkdir()
    VERB.run([f"paths.outputs={tmp_path}"])
    shown = capsys.readouterr()
    said = [line for line in shown.err.splitlines() if " INFO mlflow" not in line]  # of tables that are made
    assert said == ["atlantis_exp: left out foreign: foreign: it has no config.json"]
    assert "resnet plays better than cnn by 8,000 points (7," in " ".join(shown.out.split())
    assert f" ui paths.outputs={tmp_path} (publishes 10 runs that it lacks first)\n" in shown.out
    path = Path(shown.out.rstrip().splitlines()[-1])
    assert path.name == "comparison.html"
    assert path.is_relative_to(tmp_path / "comparisons")
    assert "resnet plays better than cnn" in path.read_text()
    assert len(list((path.parent / "figures").glob("*.png"))) == 10
    tables = {file.name for file in (path.parent / "tables").iterdir()}
    names = {"scores", "seeds", "verdict", "plan", "looks", "evaluation", "runs", "views", "skipped"}
    assert tables >= {f"{name}.{kind}" for name in names for kind in ("csv", "tex")}
    assert len(tables) == 2 * len({name.partition(".")[0] for name in tables})
    with open(path.parent / "tables" / "runs.csv") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 10
    latex = (path.parent / "tables" / "verdict.tex").read_text()
    assert r"\toprule" in latex
    assert "difference (points)" in latex

    client = mlflow.MlflowClient(f"sqlite:///{tmp_path}/mlflow.db")
    experiment = client.get_experiment_by_name("atlantis")
    assert experiment is not None
    (stored,) = client.search_runs([experiment.experiment_id])
    assert stored.info.status == "FINISHED"
    assert stored.info.run_name == path.parents[1].name
    assert stored.data.tags["atlantis.kind"] == "comparison"
    assert "resnet plays better" in stored.data.tags["mlflow.note.content"]
    assert stored.data.metrics["difference/cnn over resnet"] == -8_000
    assert {item.path for item in client.list_artifacts(stored.info.run_id)} == {"comparison.html", "figures", "tables"}
    assert "cnn-vs-resnet" in stored.info.run_name


def test_a_comparison_of_more_seeds_goes_on_in_its_run_and_one_that_fails_says_so(
    recorded: Recorded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(comparing, "draw", lambda _: {})
    for seed in range(6):
        for model, factor in (("cnn", 3), ("resnet", 7)):
            recorded(f"model={model}", f"seed={seed}", scores=(1_000.0, 1_200.0 + factor * seed % 5))
        if seed > 3:
            VERB.run([f"paths.outputs={tmp_path}"])
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path}/mlflow.db")
    (stored,) = client.search_runs(
        [each.experiment_id for each in client.search_experiments(filter_string="name='atlantis'")]
    )
    assert (stored.info.status, stored.data.params["seeds"]) == ("FINISHED", "10")
    assert "next look at 10 seeds (there are 6 each)" in stored.data.tags["mlflow.note.content"]
    (looks,) = tmp_path.glob("comparisons/*/looks.json")
    looks.write_text("{")
    with pytest.raises(Fault, match=r"looks\.json") as damaged:
        VERB.run([f"paths.outputs={tmp_path}", "tracking=none"])
    assert damaged.value.exit_code == 1
    assert RunFolder(looks.parent).state == "failed"


@pytest.mark.slow
def test_what_follows_from_the_seed_makes_no_other_comparison_and_another_recipe_does(
    recorded: Recorded, tmp_path: Path
) -> None:
    def compared(seeds: range, lr: str) -> int:
        for seed in seeds:
            for model, score in (("cnn", 1_000.0), ("resnet", 1_015.0)):
                overrides = (f"seed={seed}", f"evaluation.seed={100 + seed}", f"optimizer.lr={lr}")
                recorded(f"model={model}", *overrides, scores=(score - 40 * (seed % 5), score, score + 9 + seed))
        VERB.run([f"paths.outputs={tmp_path}", "tracking=none"])
        return len(list((tmp_path / "comparisons").glob("*/looks.json")))

    assert compared(range(5), "0.001") == 1
    assert compared(range(5, 10), "0.001") == 1
    shutil.rmtree(tmp_path / "runs")
    assert compared(range(5), "0.002") == 2


@pytest.mark.parametrize(
    ("overrides", "words", "line"),
    [
        (("env.crop=[0,160,210,0]",), (), "env.crop differs, so the scores do not mean the same: "),
        (("evaluation.epsilon=0.3",), (), "evaluation.epsilon differs"),
        ((), ("by=modle",), "by=modle: no such key"),
        ((), ("where=seed=5",), "no finished training"),
        ((), ("at_epsilon=2",), "at_epsilon=2: should be less"),
        ((), ("seed=2",), "seed=2: no such key; did you mean 'seeds'"),
    ],
)
def test_a_refusal_is_one_line_and_code_2_and_leaves_nothing_behind(
    command: Callable[..., int],
    recorded: Recorded,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    overrides: tuple[str, ...],
    words: tuple[str, ...],
    line: str,
) -> None:
    recorded()
    recorded("seed=1", *overrides)
    assert command("compare", f"paths.outputs={tmp_path}", *words) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"atlantis_exp: {line}")
    assert error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


@pytest.mark.slow
def test_a_real_training_can_be_compared(
    tiny: Callable[..., Config], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed in (0, 1):
        train(Job(tiny(f"seed={seed}")))
    VERB.run([f"paths.outputs={tmp_path}", "tracking=none", "by=seed"])
    shown = capsys.readouterr()
    assert shown.err == ""
    page = Path(shown.out.rstrip().splitlines()[-1])
    with open(page.parent / "tables" / "runs.csv") as file:
        runs = list(csv.DictReader(file))
    for row in runs:
        result = json.loads((tmp_path / "runs" / row["run"] / "result.json").read_bytes())
        assert float(row["mean (points)"]) == result["evaluation"]["evaluation/mean"]
        assert float(row["score (points)"]) == result["evaluation"]["evaluation/interquartile_mean"]
        assert float(row["frames"]) == result["counts"]["frames"]
        assert float(row["flops"]) > 0
    with open(page.parent / "tables" / "actions.csv") as file:
        shares = [
            float(row["network (fraction)"]) + float(row["random (fraction)"])
            for row in csv.DictReader(file)
            if row["group"] == "seed=0"
        ]
    assert sum(shares) == pytest.approx(1)


@pytest.fixture
def of_json(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Compared]:
    """Compares and returns the document; without figures, which take seconds."""
    monkeypatch.setattr(comparing, "draw", lambda _: {})

    def compared(*words: str) -> Compared:
        capfd.readouterr()
        VERB.run([f"paths.outputs={tmp_path}", "tracking=none", "format=json", *words])
        (line,) = capfd.readouterr().out.splitlines()
        return Compared.model_validate_json(line)

    return compared


def runs_of_the_decision() -> list[str]:
    names: list[str] = json.loads((KEPT / "decisions" / DECISION / "config.json").read_text())["runs"]
    return names


def looks_in(outputs: Path) -> list[dict[str, Any]]:
    (path,) = outputs.glob("comparisons/*/looks.json")
    (looks,) = json.loads(path.read_text()).values()
    return [*looks]


def test_a_table_of_scores_has_the_looks_and_the_verdict_of_the_runs_that_they_are_of(
    of_json: Callable[..., Compared], tmp_path: Path
) -> None:
    rows = []
    for folder in (RunFolder(KEPT / "runs" / name) for name in runs_of_the_decision()):
        result, config = folder.result, folder.trained_config
        assert result is not None
        score = result.evaluation["evaluation/interquartile_mean"]
        for shift in (-70.0, 70.0):  # rows of a seed are averaged
            rows.append((config.seed, f"{config.model.name},{config.seed},{score + shift}"))
    assert len(rows) == 40
    table = tmp_path / "scores.csv"
    for seeds in (5, 10):  # more seeds of the same table are the same comparison
        table.write_text("\n".join(["algo,seed,return", *(text for seed, text in rows if seed < seeds)]))
        answer = of_json(f"scores={table}", "columns=group=algo,score=return")
    assert (answer.question.score, answer.question.by) == ("file", ["group"])
    assert answer.decided
    assert answer.verdict.startswith("cnn plays better than resnet_fast by 13,813 points (5,327 to 22,300, 10 seeds")
    for look, kept in zip(looks_in(tmp_path), LOOKS["model"], strict=True):
        assert (look["seeds"], look["error"]) == (kept["seeds"], pytest.approx(kept["error"]))
        ((verdict,), (before,)) = look["verdicts"], kept["verdicts"]
        for key in ("group", "other", "said", "seeds"):
            assert verdict[key] == before[key]
        for key in ("difference", "low", "high"):
            assert verdict[key] == pytest.approx(before[key], rel=1e-9)
    (page,) = tmp_path.glob("comparisons/cnn-vs-resnet-fast-*/artifacts/comparison.html")
    assert "cnn plays better than resnet_fast by 13,813 points" in page.read_text()
    assert "the mean of the seed&#39;s rows in a table" in page.read_text()


def test_a_table_of_scores_is_drawn_with_its_seeds_and_nothing_else(tmp_path: Path) -> None:
    rows = [f"{group},{seed},{base + seed}" for group, base in (("a", 1.0), ("b", 9.0)) for seed in range(5)]
    (tmp_path / "s.csv").write_text("\n".join(["group,seed,score", *rows]))
    VERB.run([f"paths.outputs={tmp_path}", "tracking=none", f"scores={tmp_path / 's.csv'}", "baseline=a"])
    (page,) = tmp_path.glob("comparisons/*/artifacts/comparison.html")
    assert {path.name for path in page.parent.glob("figures/*.png")} == {"scores.png"}
    assert r"difference (points)" in (page.parent / "tables" / "scores.tex").read_text()
    for heading in ("Why", "Episodes", "Runs", "Learning"):
        assert f"<h2>{heading}" not in page.read_text()


def test_a_seed_that_one_group_of_a_table_lacks_is_named(tmp_path: Path, of_json: Callable[..., Compared]) -> None:
    rows = [f"{group},{seed},{seed}" for group in ("a", "b") for seed in range(8) if (group, seed) != ("b", 2)]
    (tmp_path / "s.csv").write_text("\n".join(["group,seed,score", *rows]))
    answer = of_json(f"scores={tmp_path / 's.csv'}")
    assert any(caveat.startswith("b lacks seed 2, which others have.") for caveat in answer.caveats)


def test_another_column_of_a_table_is_another_question_in_points_as_small_as_its_own(
    tmp_path: Path, of_json: Callable[..., Compared]
) -> None:
    two = (("x", 0.8, 0.3), ("y", 0.3, 0.8))
    rows = [f"{group},{seed},{a + seed / 100},{b + seed / 100}" for group, a, b in two for seed in range(5)]
    table = tmp_path / "two.csv"
    table.write_text("\n".join(["group,seed,a,b", *rows]))
    for column, leader in (("a", "x over y"), ("b", "y over x")):
        answer = of_json(f"scores={table}", f"columns=score={column}")
        assert answer.verdict.startswith(f"{leader[0]} plays better than {leader[-1]} by 0.5 points")
        assert not any("past looks" in caveat for caveat in answer.caveats)
        assert any(re.search(r"the corrected estimate is 0\.\d+ points", caveat) for caveat in answer.caveats)


def test_pairs_of_like_names_have_metrics_of_their_own(tmp_path: Path) -> None:
    bases = {"a+": 1.0, "a!": 9.0, "b": 20.0}
    rows = [f"{group},{seed},{base + seed}" for group, base in bases.items() for seed in range(5)]
    (tmp_path / "s.csv").write_text("\n".join(["group,seed,score", *rows]))
    VERB.run([f"paths.outputs={tmp_path}", "tracking=none", f"scores={tmp_path / 's.csv'}"])
    (folder,) = tmp_path.glob("comparisons/*")
    metrics = [record.values for record in RunFolder(folder).records() if isinstance(record, Metrics)]
    assert len({abs(value) for key, value in metrics[0].items() if not key.endswith("/decided")}) == 3


@pytest.mark.parametrize("word", ["by=seed", "runs=cnn", "where=seed=0", "at_epsilon=0.05", "score=training"])
def test_what_is_asked_of_runs_is_refused_with_a_table_of_scores(word: str, tmp_path: Path) -> None:
    key = word.partition("=")[0]
    with pytest.raises(ConfigError, match=f"^{key}: applies to runs, not to scores="):
        VERB.run([f"paths.outputs={tmp_path}", f"scores={tmp_path / 's.csv'}", word])


@pytest.mark.parametrize("columns", ["return", "score=", "points=return", "group=a,group=b"])
def test_a_column_that_is_none_of_a_table_of_scores_is_refused(columns: str) -> None:
    with pytest.raises(ConfigError, match=r"^columns="):
        VERB.run([f"columns={columns}"])


@pytest.mark.parametrize("window", ["0", "20", "120%", "half", "-0.1"])
def test_a_window_that_is_no_share_is_refused(window: str) -> None:
    with pytest.raises(ConfigError, match=r"write a share, as in window=20% or window=0\.2"):
        VERB.run([f"window={window}"])


def test_the_training_score_is_one_quantity_with_looks_of_its_own(
    of_json: Callable[..., Compared], tmp_path: Path
) -> None:
    shutil.copytree(KEPT / "decisions" / DECISION, tmp_path / "decisions" / DECISION)
    expected: dict[str, dict[int, float]] = {"cnn": {}, "resnet_fast": {}}
    for name in runs_of_the_decision():
        folder = RunFolder(shutil.copytree(KEPT / "runs" / name, tmp_path / "runs" / name))
        expected[name.partition("-")[0]][folder.trained_config.seed] = score_of(folder)
    words = ("by=model", f"runs={DECISION}", "at_epsilon=0.05")
    answer = of_json(*words, "score=training", "window=20%")
    assert {each.group: each.seeds for each in answer.scores} == expected
    (verdict,) = answer.verdicts
    means = [sum(expected[name][seed] for seed in range(verdict.seeds)) / verdict.seeds for name in expected]
    assert verdict.difference == pytest.approx(means[0] - means[1])
    assert answer.verdict.startswith("By score=training window=20%: cnn plays better than resnet_fast by ")
    assert answer.caveats[0].startswith("The score is the seed's points in the last 20% of its training")
    (page,) = tmp_path.glob("comparisons/*/artifacts/comparison.html")
    for text in (answer.caveats[0], page.read_text()):
        assert "the process of learning, not the network one keeps" in text
    for name in ("seeds", "runs"):
        with open(page.parent / "tables" / f"{name}.csv") as file:
            shown = sorted(float(row["score (points)"]) for row in csv.DictReader(file))
        assert shown == sorted(score for seeds in expected.values() for score in seeds.values())

    assert of_json(*words).question.window is None
    before = tmp_path / "comparisons" / "cnn-vs-resnet-fast-e09e14bb20" / "looks.json"  # as named before the choice
    assert json.loads(before.read_text())["model"][0]["verdicts"][0]["seeds"] == 10
    assert len(list(tmp_path.glob("comparisons/*/looks.json"))) == 2
    of_json(*words, "score=training", "window=0.3")
    assert len(list(tmp_path.glob("comparisons/*/looks.json"))) == 3
