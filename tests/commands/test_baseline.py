"""A baseline, played on the real emulator and recorded in a real store."""

from pathlib import Path

import mlflow
import pytest
from hydra import compose, initialize_config_dir

from atlantis_exp.commands.app import CONF, checked
from atlantis_exp.commands.baseline import baseline
from atlantis_exp.commands.report import report
from atlantis_exp.config import BaselineConfig, ReportConfig

OVERRIDES = ["agent=constant", "env.workers=1", "evaluation.episodes=2", "evaluation.num_envs=1"]


def composed(outputs: Path, *overrides: str) -> BaselineConfig:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return checked(BaselineConfig, compose("baseline", [*OVERRIDES, f"paths.outputs={outputs}", *overrides]))


def test_a_held_button_scores_2000_and_the_run_holds_its_report_table_picture_and_film(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    baseline(composed(tmp_path))
    printed = capsys.readouterr().out
    assert "avg score: 2000.0  high score: 2000.0  low score: 2000.0" in printed

    client = mlflow.MlflowClient(f"sqlite:///{tmp_path}/mlflow.db")
    experiment = client.get_experiment_by_name("atlantis")
    assert experiment is not None
    (run,) = client.search_runs([experiment.experiment_id])
    assert run.info.status == "FINISHED"
    assert run.data.metrics["evaluation/mean"] == 2_000
    assert run.data.metrics["actions/FIRE"] == 1
    assert run.data.metrics["actions/random_share"] == 0
    assert run.data.params["agent.name"] == "constant"
    assert [point.value for point in client.get_metric_history(run.info.run_id, "score/episode")] == [2_000, 2_000]
    artifacts = {item.path for item in client.list_artifacts(run.info.run_id)}
    assert {"best_episode.mp4", "evaluation"} <= artifacts
    tables = {item.path for item in client.list_artifacts(run.info.run_id, "evaluation")}
    assert tables == {"evaluation/episodes.csv", "evaluation/report.txt"}

    report(checked_report(tmp_path))
    table = capsys.readouterr().out
    assert run.info.run_name == f"constant 1 Atlantis-v0 {composed(tmp_path).identity()[:6]}"
    assert composed(tmp_path).run_name() in table
    assert "2,000" in table


def checked_report(outputs: Path) -> ReportConfig:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return checked(ReportConfig, compose("report", [f"paths.outputs={outputs}"]))


def test_a_report_on_an_empty_folder_says_so_and_creates_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report(checked_report(tmp_path / "nothing"))
    assert capsys.readouterr().out == f"there is no run under {tmp_path}/nothing/runs yet\n"
    assert not (tmp_path / "nothing").exists()


def test_the_identity_of_a_baseline_depends_on_its_player_and_not_on_its_processes(tmp_path: Path) -> None:
    identity = composed(tmp_path).identity()
    assert composed(tmp_path / "elsewhere", "env.workers=2", "tracking=none").identity() == identity
    for override in ("agent=random", "agent.action=2", "evaluation.seed=1", "env=atlantis_v5"):
        assert composed(tmp_path, override).identity() != identity
