"""Folders of exported weights: how they play, what is packed, and what is refused."""

import dataclasses
import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
import safetensors.torch

from atlantis_exp.build import build_network
from atlantis_exp.checking import parse, to_dict
from atlantis_exp.commands.evaluate import EvaluateConfig
from atlantis_exp.commands.overrides import check
from atlantis_exp.config import Config
from atlantis_exp.faults import ConfigError
from atlantis_exp.sessions.cards import Card, pack, portable

Command = Callable[..., int]
Compose = Callable[..., Config]


@pytest.fixture
def folder(tiny: Compose, tmp_path: Path) -> Path:
    """A folder of exported weights that nobody has trained."""
    config = portable(tiny("evaluation.epsilon=0.9", "evaluation.seed=5"))
    weights = safetensors.torch.save(build_network(config, "network").state_dict())
    card = Card(
        format=1,
        run="cnn",
        weights="latest",
        step=160,
        reached={},
        made={},
        precision="float32",
        sha256=hashlib.sha256(weights).hexdigest(),
        config=config,
        evaluation=config.evaluation,
        scores=[100.0],
    )
    path = tmp_path / "pretrained" / "untrained"
    path.mkdir(parents=True)
    (path / "weights.safetensors").write_bytes(weights)
    (path / "card.json").write_text(json.dumps(to_dict(card)))
    return path


@pytest.mark.parametrize(
    ("key", "value", "line"),
    [
        ("sha256", "0" * 64, "does not match the checksum in its card"),
        ("config.env.size", 84, "another network's"),
        ("config.env.siz", 40, "card.json: config.env.siz: no such key; did you mean 'size'?"),
        ("config.model._target_", "os.system", "card.json: config.model._target_: no such key"),
        ("config.model.name", "rnn", "card.json: config.model.name=rnn: no such choice"),
        ("config.env.crop", [0, 999, 210, 0], "card.json: env.crop=[0, 999, 210, 0]"),
        ("evaluation.episodes", 0, "card.json: evaluation.episodes=0: should be greater than or equal to 1"),
        ("format", 2, "card.json: format=2"),
        ("scores", [], "card.json: scores=[]"),
        ("scores", [1e308, 1e308], "card.json: scores.0=1e+308: should be less than or equal to 1000"),
        (
            "scores",
            [0] * 1_000_001,
            "...: should have at most 1000000 items",
        ),
    ],
)
def test_a_folder_that_was_tampered_with_is_one_line(
    command: Command, folder: Path, capsys: pytest.CaptureFixture[str], key: str, value: Any, line: str
) -> None:
    tree = json.loads((folder / "card.json").read_text())
    *path, last = key.split(".")
    node = tree
    for part in path:
        node = node[part]
    node[last] = value
    (folder / "card.json").write_text(json.dumps(tree))
    assert command("evaluate", f"weights={folder}", f"paths.outputs={folder.parent}/o") in (1, 2)
    error = capsys.readouterr().err
    assert line in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("asked", "protocol"),
    [
        pytest.param(("evaluation.num_envs=2",), ["2", "0.9", "5"], marks=pytest.mark.slow),
        pytest.param(("episodes=1",), ["1", "0.9", "5"], marks=pytest.mark.slow),
        (("evaluation=quick", "episodes=1"), ["1", "0.05", "1000003"]),
    ],
)
def test_another_protocol_than_the_card_s_is_played_where_the_command_line_says_so(
    command: Command,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    asked: tuple[str, ...],
    protocol: list[str],
) -> None:
    outputs = (f"paths.outputs={folder.parent}/o", "device=cpu", "tracking=none")
    assert command("evaluate", f"weights={folder}", *outputs, *asked, "evaluation.video=false") == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("│ here")]
    assert [cell.strip() for cell in line.split("│")][-4:-1] == protocol


@pytest.mark.parametrize("content", ["", "{", "[]", '{"format": 1}'])
def test_a_card_that_is_none_is_one_line(
    command: Command, folder: Path, capsys: pytest.CaptureFixture[str], content: str
) -> None:
    (folder / "card.json").write_text(content)
    assert command("evaluate", f"weights={folder}", f"paths.outputs={folder.parent}/o") == 2
    error = capsys.readouterr().err
    assert error.startswith(f"atlantis_exp: weights={folder}: card.json: ")
    assert error.count("\n") == 1


def test_where_the_shipped_weights_are_is_said_outside_a_checkout(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command("evaluate", "weights=pretrained/cnn_fast", f"paths.outputs={tmp_path}/o") == 2
    assert "the shipped weights are in pretrained/ of the repository" in capsys.readouterr().err


def test_a_pipe_in_a_card_s_place_is_one_line(
    command: Command, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "card.json").unlink()
    os.mkfifo(folder / "card.json")
    assert command("evaluate", f"weights={folder}", f"paths.outputs={folder.parent}/o") == 2
    assert f"weights={folder}: card.json: {folder}/card.json is not a regular file\n" in capsys.readouterr().err


def test_weights_that_are_not_numbers_are_not_played(
    command: Command, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arrays = safetensors.numpy.load_file(folder / "weights.safetensors")
    weights = safetensors.numpy.save({name: np.full_like(array, np.nan) for name, array in arrays.items()})
    (folder / "weights.safetensors").write_bytes(weights)
    card = json.loads((folder / "card.json").read_text())
    (folder / "card.json").write_text(json.dumps({**card, "sha256": hashlib.sha256(weights).hexdigest()}))
    assert command("evaluate", f"weights={folder}", f"paths.outputs={folder.parent}/o") == 1
    assert "the weights are not all finite numbers" in capsys.readouterr().err


def test_a_misspelt_folder_and_a_run_beside_a_folder_are_one_line(
    command: Command, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    outputs = f"paths.outputs={folder.parent}/o"
    assert command("evaluate", f"weights={folder.parent}/untraind", outputs) == 2
    assert f"did you mean '{folder}'?" in capsys.readouterr().err
    assert command("evaluate", f"weights={folder}", "run=latest", outputs) == 2
    assert capsys.readouterr().err.startswith("atlantis_exp: run=latest: ")


def test_a_folder_of_this_place_is_named_without_a_path(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder.parent)
    ((_, config),) = check("evaluate", EvaluateConfig, ["weights=untrained"]).items()
    assert config.weights == "untrained"
    with pytest.raises(ConfigError, match="weights=untraind: not a folder"):
        check("evaluate", EvaluateConfig, ["weights=untraind"])


def test_weights_are_packed_in_half_precision_only_above_eight_megabytes() -> None:
    def file(megabytes: float) -> bytes:
        count = int(megabytes * 250_000)
        return safetensors.numpy.save({"w": np.linspace(-1, 1, count, dtype=np.float32), "n": np.array([3])})

    assert pack(file(7.9)) == (file(7.9), "float32")
    packed, precision = pack(file(8.1))
    assert precision == "float16"
    assert len(packed) < 4_100_000
    arrays = safetensors.numpy.load(packed)
    assert arrays["w"].dtype == np.float16
    assert arrays["n"].tolist() == [3]


def test_a_card_names_weights_that_lay_here_without_a_place(tiny: Compose) -> None:
    config = tiny()
    for place, name in ((".", "weights"), ("/", "weights"), ("../best", "best")):
        begun = dataclasses.replace(config.training, weights=f"{place}@{16 * '0'}")
        assert portable(dataclasses.replace(config, training=begun)).training.weights == f"{name}@{16 * '0'}"


def test_a_card_holds_nothing_of_the_machine_and_all_of_the_science(tiny: Compose) -> None:
    config = tiny("env.workers=1", "tracking.uri=http://10.0.0.1:5000")
    card = portable(config)
    assert card.science() == config.science()
    assert card.identity() == config.identity()
    assert (card.env.workers, card.tracking.uri, card.threads, card.paths.outputs) == (None, None, None, "outputs")
    assert parse(Config, to_dict(card)) == card
