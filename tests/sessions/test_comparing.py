"""The verb compare, from the command line to the page and the store."""

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import mlflow
import pytest

from atlantis_exp.commands.compare import VERB
from atlantis_exp.config import Config
from atlantis_exp.sessions.job import Job
from atlantis_exp.sessions.training import train

Recorded = Callable[..., Path]


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


@pytest.mark.slow
def test_the_same_comparison_again_is_the_same_run(recorded: Recorded, tmp_path: Path) -> None:
    recorded()
    for _ in range(2):
        VERB.run([f"paths.outputs={tmp_path}", "tracking=none"])
    assert len(list((tmp_path / "comparisons").iterdir())) == 1


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
        ((), ("where=seed=5",), "there is no finished training"),
        ((), ("at_epsilon=2",), "at_epsilon=2: should be less"),
        ((), ("seed=2",), "seed=2: no such key; did you mean 'seeds'"),
    ],
)
def test_a_refusal_is_one_line_and_code_2_and_leaves_nothing_behind(
    recorded: Recorded,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    overrides: tuple[str, ...],
    words: tuple[str, ...],
    line: str,
) -> None:
    recorded()
    recorded("seed=1", *overrides)
    with pytest.raises(SystemExit, match="2"):
        VERB.run([f"paths.outputs={tmp_path}", *words])
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
