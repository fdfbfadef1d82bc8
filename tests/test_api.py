"""Train, evaluate and compare as a notebook does."""

import signal
import threading
import time
from pathlib import Path

import pytest

import atlantis_exp
from atlantis_exp.faults import ConfigError


def test_ten_lines_train_evaluate_compare_and_read(tiny_overrides: tuple[str, ...], tmp_path: Path) -> None:
    where = f"paths.outputs={tmp_path}"
    for model in ("cnn_small", "cnn"):
        run = atlantis_exp.train(*tiny_overrides, where, f"model={model}")
        assert run.result is not None
        assert run.result.outcome == "finished"
    again = atlantis_exp.train(*tiny_overrides, where, "model=cnn")
    assert again == run
    played = atlantis_exp.evaluate(f"run={run.name}", "episodes=3", "evaluation.video=false", "tracking=none", where)
    assert played.result is not None
    assert played.result.evaluation["evaluation/episodes"] == 3
    comparison = atlantis_exp.compare("by=model", "tracking=none", where)
    assert comparison.groups == ["cnn", "cnn_small"]
    assert "ot decided" in comparison.verdict
    assert [*atlantis_exp.load_runs(tmp_path).runs["model.name"]] == ["cnn", "cnn_small"]


def test_a_mistake_is_raised_in_the_words_of_the_command_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"^optimizer.lrr=1: no such key; did you mean 'optimizer.lr'"):
        atlantis_exp.train("optimizer.lrr=1", f"paths.outputs={tmp_path}")
    with pytest.raises(ConfigError, match="makes 2 jobs; call train once for each"):
        atlantis_exp.train("-m", "seed=0,1", f"paths.outputs={tmp_path}")
    assert not [*tmp_path.iterdir()]
    with pytest.raises(AttributeError, match="no attribute 'trian'"):
        _ = atlantis_exp.trian


def test_ctrl_c_after_the_last_step_is_raised_once_all_is_published(
    tiny_overrides: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("atlantis_exp.sessions.training.train", lambda _: signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        atlantis_exp.train(*tiny_overrides, f"paths.outputs={tmp_path}")


def test_ctrl_c_commits_a_training_which_the_same_call_continues(
    tiny_overrides: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = (each for each in tiny_overrides if not each.startswith("phase.quick.steps="))
    words = (*kept, "phase.quick.steps=100_000", f"paths.outputs={tmp_path}")

    def interrupt() -> None:
        while not [*tmp_path.glob("runs/*/config.json")]:
            time.sleep(0.05)
        signal.raise_signal(signal.SIGINT)

    thread = threading.Thread(target=interrupt, daemon=True)
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        atlantis_exp.train(*words)
    thread.join()
    (run,) = tmp_path.glob("runs/*")
    assert [*run.glob("checkpoints/*/manifest.json")]
    assert not (run / "result.json").exists()
    atlantis_exp.train(*words, "budget.steps=1")
    assert f"continuing run {run.name} at step " in capsys.readouterr().out
