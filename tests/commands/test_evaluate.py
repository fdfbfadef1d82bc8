"""Evaluation of stored runs: which run is meant."""

import json
import sys
from pathlib import Path

import pytest

from atlantis_exp.commands import evaluate


def run(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["atlantis_exp", *words])
    with pytest.raises(SystemExit) as ended:
        evaluate.main()
    assert isinstance(ended.value.code, int)
    return ended.value.code


@pytest.fixture
def outputs(tmp_path: Path) -> Path:
    for name in ("cnn-uniform-s0-aa", "cnn-uniform-s1-bb"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "config.json").write_text(json.dumps({"model": {}}))
    return tmp_path


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("cnn-uniform-s2", "atlantis_exp: run=cnn-uniform-s2: no such run; did you mean 'cnn-uniform-s"),
        ("cnn", "atlantis_exp: run=cnn: could be any of cnn-uniform-s0-aa, cnn-uniform-s1-bb"),
    ],
)
def test_an_unknown_run_is_one_line_that_names_the_nearest(
    outputs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str, line: str
) -> None:
    assert run(monkeypatch, f"run={name}", f"paths.outputs={outputs}") == 2
    error = capsys.readouterr().err
    assert error.startswith(line)
    assert error.count("\n") == 1


def test_no_run_at_all_is_one_line_and_nothing_is_created(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, f"paths.outputs={tmp_path}/o") == 2
    assert capsys.readouterr().err == f"atlantis_exp: run=latest: there is no training run under {tmp_path}/o/runs\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("damaged", ["", "{", "[]", '{"model": {}}', '{"model": {"_target_": "os.system"}}'])
def test_a_damaged_config_is_one_line_that_names_its_file(
    outputs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], damaged: str
) -> None:
    path = outputs / "runs/cnn-uniform-s0-aa/config.json"
    path.write_text(damaged)
    assert run(monkeypatch, "run=cnn-uniform-s0-aa", f"paths.outputs={outputs}") in (1, 2)
    error = capsys.readouterr().err
    assert error.startswith(f"atlantis_exp: {path}")
    assert error.count("\n") == 1


@pytest.mark.parametrize("name", ["epsilon", "episodes"])
def test_epsilon_and_episodes_are_the_evaluations(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    assert run(monkeypatch, f"{name}=-1") == 2
    assert f"evaluation.{name}=-1: should be greater than or equal to" in capsys.readouterr().err
