"""Run folders as data frames, and the example of docs/notebooks.md."""

import json
import re
import shutil
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from atlantis_exp import load_runs
from atlantis_exp.comparison.estimands import score_of
from atlantis_exp.comparison.export_tables import UNITS
from atlantis_exp.comparison.gather import gather
from atlantis_exp.components import facts_of, game_of
from atlantis_exp.faults import ConfigError
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.journal import Journal
from atlantis_exp.statistics import summarize
from atlantis_exp.training.evaluation import Episode, Evaluation

Recorded = Callable[..., Path]
ATLANTIS = facts_of(game_of("Atlantis-v0"))
PAGE = Path(__file__).resolve().parents[2] / "docs" / "notebooks.md"
COLUMNS = PAGE.with_name("columns.md")
KEPT = PAGE.parents[1] / "results" / "verdict" / "runs"


def episodes(*scores: float) -> Evaluation:
    """Episodes of three decisions, the last of them random."""
    played = [
        Episode(seed, score, 9, False, bytearray([1, 1, 1]), bytearray([0, 0, 1])) for seed, score in enumerate(scores)
    ]
    return Evaluation(0.05, played, replace(ATLANTIS, sources=()))


def tag(folder: Path, *values: dict[str, str]) -> None:
    """Say more about a run that is recorded."""
    journal = Journal(folder)
    journal.load_state_dict({"offset": (folder / "journal.jsonl").stat().st_size, "time": 0})
    for each in values:
        journal.tags(each)
    journal.finish()


def evaluated(outputs: Path, run: str, *scores: float, name: str = "again", step: int = 160) -> Path:
    """What the verb `evaluate` leaves, as far as it is read."""
    folder = outputs / "evaluations" / name
    journal = Journal(folder)
    facts = {"run": run, "step": step, "evaluation": {"epsilon": 0.05, "seed": 5}}
    (folder / "config.json").write_text(json.dumps(facts))
    journal.artifact("evaluation/episodes.csv", episodes(*scores).table().to_csv().encode())
    journal.finish()
    (folder / "result.json").write_text("{}")
    return folder


def baseline(outputs: Path, *scores: float) -> Path:
    """What the verb `baseline` leaves, as far as it is read."""
    folder = outputs / "runs" / "random-Atlantis-v0"
    journal = Journal(folder, {"atlantis.kind": "baseline", "mlflow.runName": "random player"})
    config = {"agent": {"name": "random"}, "evaluation": {"epsilon": 0.05, "seed": 3}, "env": {"frameskip": 4}}
    (folder / "config.json").write_text(json.dumps(config))
    journal.artifact("evaluation/episodes.csv", episodes(*scores).table().to_csv().encode())
    journal.finish()
    result = {"outcome": "finished", "steps": 0, "counts": {}, "evaluation": {}, "report": ""}
    (folder / "result.json").write_text(json.dumps(result))
    return folder


def test_a_run_is_a_row_with_its_config_its_result_and_its_tags(recorded: Recorded, tmp_path: Path) -> None:
    folder = recorded("seed=7", scores=(300.0, 100.0))
    said = {"git.commit": "f00d", "precision": "float32", "policy": "first", "mlflow.note.content": "long"}
    tag(folder, said, {"policy": "collapsed: NOOP"})
    loaded = load_runs(tmp_path)
    (row,) = loaded.runs.to_dict("records")
    assert loaded.skipped == {}
    assert (row["run"], row["kind"], row["state"], row["error"]) == (folder.name, "training", "done", "")
    assert (row["seed"], row["model.name"], row["env.frameskip"]) == (7, "cnn", "[2, 5]")
    assert (row["result.outcome"], row["result.steps"], row["evaluation/mean"]) == ("finished", 160, 200.0)
    assert (row["tag.git.commit"], row["tag.precision"], row["tag.policy"]) == ("f00d", "float32", "collapsed: NOOP")
    assert not [column for column in row if "mlflow" in column]
    assert loaded.runs["started"].dt.tz is not None
    assert abs((pd.Timestamp.now("UTC") - row["updated"]).total_seconds()) < 600


def test_an_evaluation_is_a_row_of_what_its_episodes_say(recorded: Recorded, tmp_path: Path) -> None:
    scores = (1_000.0, 2_000.0, 3_000.0, 9_000.0)
    folder = recorded(scores=scores, truncated=1)
    (row,) = load_runs(tmp_path).evaluations.to_dict("records")
    summary = summarize(scores)
    assert (row["run"], row["step"], row["source"], row["final"]) == (folder.name, 160, "training", True)
    assert (row["folder"], row["epsilon"], row["episodes"]) == (f"runs/{folder.name}", 0.05, 4)
    assert (row["mean"], row["iqm"], row["median"]) == (summary.mean, summary.interquartile_mean, summary.median)
    assert (row["lower_quartile"], row["upper_quartile"]) == (summary.lower_quartile, summary.upper_quartile)
    assert (row["low"], row["high"], row["standard_error"]) == (1_000, 9_000, summary.standard_error)
    assert row["points_per_frame"] == sum(scores) / (4 * 12)
    assert (row["steps_mean"], row["truncated_share"], row["random_share"]) == (4, 0.25, 0.25)
    assert [row[source] for source in ATLANTIS.sources] == [0, 3_750 / 4, 0, 0, 3_750 * 3 / 4]


def test_an_episode_is_a_row_with_the_evaluation_that_it_is_of(recorded: Recorded, tmp_path: Path) -> None:
    folder = recorded(scores=(300.0, 100.0), truncated=1)
    loaded = load_runs(tmp_path)
    place = {"run": folder.name, "step": 160, "source": "training", "folder": f"runs/{folder.name}"}
    ends = {"steps": 4, "frames": 12, "random_share": 0.25}
    unpaid = {"centre_vessel": 0.0, "centre_bomber": 0.0, "side_bomber": 0.0}
    first, second = ({**unpaid, "side_vessel": score / 4, "wave_bonus": score * 3 / 4} for score in (300.0, 100.0))
    assert loaded.episodes.to_dict("records") == [
        {**place, "episode": 0, "seed": 0, "score": 300.0, **ends, "truncated": True, **first},
        {**place, "episode": 1, "seed": 1, "score": 100.0, **ends, "truncated": False, **second},
    ]
    assert loaded.episodes.dtypes[["step", "frames", "truncated"]].astype(str).tolist() == ["int64", "int64", "bool"]


def test_evaluations_of_one_step_are_in_the_order_in_which_they_were_made_and_the_last_is_compares(
    recorded: Recorded, tmp_path: Path
) -> None:
    name = recorded(scores=(300.0,)).name
    evaluated(tmp_path, name, 5.0, name="z made first")
    time.sleep(0.002)  # times are in ms
    evaluated(tmp_path, name, 6.0, name="a made last")
    evaluated(tmp_path, name, 4.0, name="of the middle", step=80)
    evaluated(tmp_path, "another run", 1.0, name="of a run that is not here")
    evaluations = load_runs(tmp_path).evaluations
    assert evaluations["mean"].tolist() == [4, 300, 5, 6]
    assert evaluations["final"].tolist() == [False, True, True, True]
    assert evaluations["source"].tolist() == ["evaluate", "training", "evaluate", "evaluate"]
    assert evaluations["folder"].tolist()[-1] == "evaluations/a made last"
    (training,) = gather(tmp_path).trainings
    assert training.episodes.scores.tolist() == [6]


def test_a_curve_is_in_long_form_and_says_how_far_the_training_was(recorded: Recorded, tmp_path: Path) -> None:
    folder = recorded(curve=((3, 0.1, 0, 50), (6, 0.3, 2, 70)), flops=1_000)
    curves = load_runs(tmp_path).curves
    assert set(curves["key"]) == {"learning/updates", "score/mean_100", "actions/epsilon"}
    assert curves[curves["key"] == "score/mean_100"].to_dict("records") == [
        {"run": folder.name, "step": 1, "frames": 3, "hours": 0.1, "flops": 0, "key": "score/mean_100", "value": 50},
        {"run": folder.name, "step": 2, "frames": 6, "hours": 0.3, "flops": 2e3, "key": "score/mean_100", "value": 70},
    ]


def test_a_long_curve_is_sampled_with_its_ends_and_in_full_on_request(recorded: Recorded, tmp_path: Path) -> None:
    recorded(curve=[(3 * i, 0.1 * i, i, i) for i in range(1_000)], flops=None)
    steps = load_runs(tmp_path, points=10).curves["step"].unique()
    assert 10 <= len(steps) <= 12
    assert (steps[0], steps[-1]) == (0, 999)
    every = load_runs(tmp_path, points=None).curves
    assert every["step"].unique().tolist() == list(range(1_000))
    assert every["flops"].isna().all()
    with pytest.raises(ValueError, match="points=0"):
        load_runs(tmp_path, points=0)


def test_a_baseline_is_a_run_without_curve_and_epsilon(recorded: Recorded, tmp_path: Path) -> None:
    recorded()
    folder = baseline(tmp_path, 40.0, 60.0)
    loaded = load_runs(tmp_path)
    row = loaded.runs.set_index("run").loc[folder.name]
    assert (row["kind"], row["title"], row["agent.name"]) == ("baseline", "random player", "random")
    assert row["env.frameskip"] == "4"  # a string: other runs have lists
    evaluation = loaded.evaluations.set_index("run").loc[folder.name]
    assert (evaluation["source"], evaluation["step"], evaluation["mean"]) == ("baseline", 0, 50)
    assert (evaluation["final"], evaluation["evaluation_seed"]) == (True, 3)
    assert np.isnan(evaluation["epsilon"])
    assert folder.name not in set(loaded.curves["run"])


def test_a_run_that_goes_on_is_there_with_what_is_committed(recorded: Recorded, tmp_path: Path) -> None:
    folder = recorded(scores=(300.0,))
    (folder / "result.json").unlink()
    uncommitted = b'{"kind":"artifact","path":"evaluation/000000200.csv"}\n{"kind":"tags","values":{"policy":"x"}}\n'
    with open(folder / "journal.jsonl", "ab") as file:
        file.write(uncommitted)
    loaded = load_runs(tmp_path)
    assert loaded.runs["state"].tolist() == ["interrupted"]
    assert "tag.policy" not in loaded.runs
    assert loaded.evaluations[["step", "final"]].values.tolist() == [[160, False]]


def test_a_run_that_is_made_longer_has_no_result_yet(recorded: Recorded, tmp_path: Path) -> None:
    Journal(recorded("budget.steps=160", outcome="budget")).status("KILLED")
    loaded = load_runs(tmp_path)
    assert loaded.runs["state"].tolist() == ["interrupted"]
    assert "result.steps" not in loaded.runs
    assert loaded.evaluations[["step", "final"]].values.tolist() == [[160, False]]


def test_the_runs_of_a_decision_are_chosen_by_its_name(recorded: Recorded, tmp_path: Path) -> None:
    run = recorded("seed=1")
    recorded("seed=2")
    decision = tmp_path / "decisions" / "decide-x"
    decision.mkdir(parents=True)
    (decision / "config.json").write_text(json.dumps({"runs": [run.name]}))
    assert load_runs(tmp_path, runs="decide-x").runs["seed"].tolist() == [1]


def test_what_cannot_be_read_is_named_in_a_warning_and_the_others_are_there(recorded: Recorded, tmp_path: Path) -> None:
    good = recorded("seed=1").name
    broken = {
        "seed=2": ("journal.jsonl", b"not a journal"),
        "seed=3": ("result.json", b"{"),
        "seed=4": ("config.json", b"[1]"),
        "seed=5": ("commit.json", b"{}"),
        "seed=6": ("config.json", b'{"model": {"name": "nonesuch"}}'),
        "seed=7": ("config.json", b'{"what": "is this"}'),
        "seed=8": ("artifacts/evaluation/000000160.csv", b"score\n1\n"),
        "seed=9": ("artifacts/evaluation/000000160.csv", b"\xff\xfe\x00"),
    }
    names = set()
    for override, (file, content) in broken.items():
        folder = recorded(override)
        (folder / file).write_bytes(content)
        names.add(folder.name)
    (evaluated(tmp_path, good, 1.0, name="torn") / "config.json").write_bytes(b'{"run": "%s"}' % good.encode())
    put_aside = recorded("seed=10")
    put_aside.rename(put_aside.with_name(put_aside.name + "~1"))
    with pytest.warns(UserWarning, match="left out") as said:
        loaded = load_runs(tmp_path)
    assert loaded.runs["run"].tolist() == [good]
    assert set(loaded.evaluations["run"]) == set(loaded.episodes["run"]) == set(loaded.curves["run"]) == {good}
    assert set(loaded.skipped) == {*names, "evaluations/torn", put_aside.name + "~1"}
    texts = [str(warning.message) for warning in said]
    assert len(texts) == len(names) + 1
    assert all(any(name in text for text in texts) for name in (*names, "evaluations/torn"))
    assert all("\n" not in text for text in texts)
    assert {warning.filename for warning in said} == {__file__}


@pytest.mark.parametrize(
    ("runs", "where", "seeds"),
    [
        ((), "seed=1", [1]),
        ((), ["env.frameskip=[2, 5]", "model=cnn"], [1, 2]),
        ("cnn", (), [1, 2]),
        ("*s2", (), [2]),
        (["cnn-uniform-s1", "*s1"], "model=cnn", [1]),
        ("cnn", "model=resnet", []),
    ],
)
def test_runs_are_chosen_as_by_compare(
    recorded: Recorded, tmp_path: Path, runs: str | list[str], where: str | list[str], seeds: list[int]
) -> None:
    recorded("seed=1")
    recorded("seed=2")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = load_runs(tmp_path, runs=runs, where=where)
    assert sorted(loaded.runs["seed"] if seeds else []) == seeds


def test_mistakes_are_named(recorded: Recorded, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="nowhere"):
        load_runs(tmp_path / "nowhere")
    recorded()
    with pytest.raises(ConfigError, match=r"where=sed: no such key; did you mean 'seed'"):
        load_runs(tmp_path, where="sed=1")
    with pytest.raises(ConfigError, match=r"runs=cmn: no such run under .*\(valid: cnn-uniform-s0"):
        load_runs(tmp_path, runs="cmn")


def test_frames_without_runs_have_their_columns(recorded: Recorded, tmp_path: Path) -> None:
    recorded()
    full, empty = load_runs(tmp_path), load_runs(tmp_path, where="seed=99")
    for name in ("evaluations", "episodes", "curves"):
        assert getattr(empty, name).columns.tolist() == getattr(full, name).columns.tolist()
        assert getattr(empty, name).empty
    assert empty.evaluations[empty.evaluations["final"]].groupby("run").tail(1).empty
    assert empty.runs.columns.tolist() == full.runs.columns.tolist()[: len(empty.runs.columns)]


def test_every_frame_survives_parquet(recorded: Recorded, tmp_path: Path) -> None:
    recorded()
    baseline(tmp_path, 40.0, 60.0)
    loaded = load_runs(tmp_path)
    for name in ("runs", "evaluations", "episodes", "curves"):
        frame = getattr(loaded, name)
        frame.to_parquet(tmp_path / f"{name}.parquet")
        pd.testing.assert_frame_equal(pd.read_parquet(tmp_path / f"{name}.parquet"), frame, check_dtype=False)


@pytest.mark.parametrize("points", [2, 1, 0])  # of a curve; none before the first episode ends
def test_the_example_of_the_page_runs(
    recorded: Recorded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, points: int
) -> None:
    curve = ((0, 0, 0, 1_000), (600, 0.5, 30, 2_000))[:points]
    for sampler in ("uniform", "top_half"):
        for seed in (0, 1):
            overrides = (f"phase.quick.sampler={sampler}", f"sampler={sampler}", f"seed={seed}")
            scores = (1_000.0, 2_000.0, 3_000.0 + seed)
            path = recorded(*overrides, f"paths.outputs={tmp_path}/outputs", scores=scores, curve=curve)
            tag(path, {"policy": "FIRE in 40.0% of the network's decisions"})
            result = json.loads((path / "result.json").read_text())
            (path / "result.json").write_text(json.dumps({**result, "counts": {"frames": 600}}))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    assert len(blocks) == 4
    names: dict[str, object] = {}
    for block in blocks:
        exec(block, names)
    by_sampler = names["by_sampler"]
    assert isinstance(by_sampler, pd.DataFrame)
    assert by_sampler["count"].to_dict() == {"top_half": 2, "uniform": 2}
    assert (tmp_path / "training.pdf").read_bytes().startswith(b"%PDF")
    assert r"sampler.name & seed & epsilon & iqm (points)" in (tmp_path / "iqm.tex").read_text()


def test_the_page_lists_all_columns_with_their_units(recorded: Recorded, tmp_path: Path) -> None:
    recorded()
    loaded = load_runs(tmp_path)
    listed = {}
    for section in re.split(r"^`loaded\.", COLUMNS.read_text().partition("## Columns")[2], flags=re.MULTILINE)[1:]:
        rows = re.findall(r"^\| (`.*?) \| (.*?) ?\|", section, re.MULTILINE)
        listed[section.partition("`")[0]] = {
            name: unit for names, unit in rows for name in re.findall(r"`(.+?)`", names)
        }
    for frame in ("evaluations", "episodes", "curves"):
        assert listed[frame].keys() == set(getattr(loaded, frame).columns)
        units = {name: unit for name, unit in listed[frame].items() if name not in ("value", "step")}
        assert units == {name: UNITS.get(name, "") for name in units}
    assert {name for name in listed["runs"] if "." not in name and "/" not in name} - {"seed"} == {
        *("run", "title", "kind", "group", "state", "error", "started", "updated", "score")
    }


def test_the_package_is_imported_without_pandas() -> None:
    code = "import sys, atlantis_exp; assert not {'pandas', 'numpy', 'pydantic'} & set(sys.modules), sys.modules.keys()"
    subprocess.run([sys.executable, "-c", code], check=True)
    code = "import sys; from atlantis_exp import load_runs; assert not {'pandas', 'torch', 'mlflow'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_score_of_a_run_is_that_of_its_comparison(recorded: Recorded, tmp_path: Path) -> None:
    recorded()
    for name in ("cnn-uniform-s0-82f1fe3874", "cnn-uniform-s1-e6500989ab"):
        shutil.copytree(KEPT / name, tmp_path / "runs" / name)
    baseline(tmp_path, 40.0, 60.0)
    last = load_runs(tmp_path).runs.set_index("run")
    evaluated = "evaluation/interquartile_mean"
    trained = last[last["kind"] == "training"]
    assert trained["score"].tolist() == trained[evaluated].tolist()
    assert last[last["kind"] == "baseline"]["score"].isna().all()
    kept = [name for name in last.index if name.startswith("cnn-uniform-s") and (KEPT / name).is_dir()]
    with pytest.warns(UserWarning, match=r"^cnn-uniform-s0-.* has no training score: .*episodes\.csv"):
        ended = load_runs(tmp_path, score="training", window="30%")
    scores = ended.runs.set_index("run")["score"]
    assert scores[kept].tolist() == [score_of(RunFolder(tmp_path / "runs" / name), 0.3) for name in kept]
    with pytest.warns(UserWarning, match=r"cnn-uniform-s.* has no training score: \d+ episodes ended in the last 1%"):
        few = load_runs(tmp_path, runs=kept, score="training", window=0.01)
    assert few.runs["score"].isna().all()
    with pytest.raises(ConfigError, match=r"^window=2: write a share"):
        load_runs(tmp_path, score="training", window=2)
    with pytest.raises(ValueError, match=r"^score=best: should be last or training"):
        load_runs(tmp_path, score="best")  # type: ignore[arg-type]
