"""Exported weights: what a folder of them holds, how it plays, and what is refused."""

import hashlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
import safetensors.torch

from atlantis_exp.build import build_network
from atlantis_exp.commands import cards, evaluate, export
from atlantis_exp.commands.cards import MOST_BYTES, pack, portable, read_card
from atlantis_exp.commands.train import train
from atlantis_exp.config import CardConfig, Config, parse, to_dict
from atlantis_exp.faults import Fault

Compose = Callable[..., Config]


def run(monkeypatch: pytest.MonkeyPatch, verb: Any, *words: str) -> int:
    """The verb's exit code."""
    monkeypatch.setattr(sys, "argv", ["atlantis_exp", *words])
    try:
        verb.main()
    except SystemExit as ended:
        return int(str(ended.code))
    return 0


@pytest.fixture
def trained(tiny: Compose) -> Path:
    """The outputs folder of a training with evaluations at steps 80 and 160."""
    config = tiny("env.max_steps=200")
    train(config)
    return Path(config.paths.outputs)


def test_exported_weights_score_what_their_card_says(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In half precision, which is what this limit takes."""
    monkeypatch.setattr(cards, "MOST_BYTES", 300_000)
    folder = tmp_path / "pretrained" / "tiny"
    outputs = (f"paths.outputs={trained}", "device=cpu")
    assert run(monkeypatch, export, f"to={folder}", "episodes=3", "epsilon=0.9", "evaluation.num_envs=1", *outputs) == 0

    card, weights = read_card(folder)
    assert card.precision == "float16"
    best = safetensors.numpy.load_file(next(trained.glob("runs/*/artifacts/best.safetensors")))
    for name, array in safetensors.numpy.load(weights).items():
        np.testing.assert_array_equal(array, best[name].astype(np.float16))
    (trained_step,) = {int(path.stem) for path in trained.glob("runs/*/artifacts/evaluation/*.csv")} & {card.step}
    assert (card.weights, trained_step) == ("best", card.step)
    assert card.reached["frames"] >= 2 * card.step
    assert len(card.scores) == 3
    assert len(set(card.scores)) > 1
    page = (folder / "README.md").read_text()
    assert card.sha256 in page
    assert f"| {np.mean(card.scores):,.0f} |" in page
    assert not any(str(trained) in path.read_text() for path in (folder / "README.md", folder / "card.json"))

    capsys.readouterr()
    played = (f"weights={folder}", *outputs, "tracking=none")
    assert run(monkeypatch, evaluate, *played) == 0
    table = [[cell.strip() for cell in line.split("│")] for line in capsys.readouterr().out.splitlines()]
    rows = {row[1]: row[2:-1] for row in table if len(row) > 3}
    assert rows["card"] == rows["here"]
    assert rows["card"][-3:] == ["3", "0.9", "2000003"]
    (recorded,) = (trained / "evaluations").iterdir()
    facts = json.loads((recorded / "config.json").read_text())
    assert (facts["sha256"], facts["evaluation"]["num_envs"]) == (card.sha256, 1)
    assert (recorded / "artifacts" / "best_episode.mp4").stat().st_size > 1_000


@pytest.fixture
def folder(tiny: Compose, tmp_path: Path) -> Path:
    """A folder of exported weights that nobody has trained."""
    config = portable(tiny("evaluation.epsilon=0.9", "evaluation.seed=5"))
    weights = safetensors.torch.save(build_network(config, "network").state_dict())
    card = CardConfig(
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
        ("sha256", "0" * 64, "does not have the checksum of its card"),
        ("config.env.size", 84, "another network's"),
        ("config.env.siz", 40, "card.json: config.env.siz: no such key; did you mean 'size'?"),
        ("config.model._target_", "os.system", "card.json: config.model._target_: no such key"),
        ("config.model.name", "rnn", "card.json: config.model.name=rnn: no such choice"),
        ("config.env.crop", [0, 999, 210, 0], "card.json: env.crop=[0, 999, 210, 0]"),
        ("evaluation.episodes", 0, "card.json: evaluation.episodes=0: should be greater than or equal to 1"),
        ("format", 2, "card.json: format=2"),
        ("scores", [], "card.json: scores=[]"),
    ],
)
def test_a_folder_that_was_tampered_with_is_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], key: str, value: Any, line: str
) -> None:
    tree = json.loads((folder / "card.json").read_text())
    *path, last = key.split(".")
    node = tree
    for part in path:
        node = node[part]
    node[last] = value
    (folder / "card.json").write_text(json.dumps(tree))
    assert run(monkeypatch, evaluate, f"weights={folder}", f"paths.outputs={folder.parent}/o") in (1, 2)
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
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    asked: tuple[str, ...],
    protocol: list[str],
) -> None:
    outputs = (f"paths.outputs={folder.parent}/o", "device=cpu", "tracking=none")
    assert run(monkeypatch, evaluate, f"weights={folder}", *outputs, *asked, "evaluation.video=false") == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("│ here")]
    assert [cell.strip() for cell in line.split("│")][-4:-1] == protocol


@pytest.mark.parametrize("content", ["", "{", "[]", '{"format": 1}'])
def test_a_card_that_is_none_is_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], content: str
) -> None:
    (folder / "card.json").write_text(content)
    assert run(monkeypatch, evaluate, f"weights={folder}", f"paths.outputs={folder.parent}/o") == 2
    error = capsys.readouterr().err
    assert error.startswith(f"atlantis_exp: {folder}/card.json: ")
    assert error.count("\n") == 1


def test_a_misspelt_folder_and_a_run_beside_a_folder_are_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    outputs = f"paths.outputs={folder.parent}/o"
    assert run(monkeypatch, evaluate, f"weights={folder.parent}/untraind", outputs) == 2
    assert f"did you mean '{folder}'?" in capsys.readouterr().err
    assert run(monkeypatch, evaluate, f"weights={folder}", "run=latest", outputs) == 2
    assert capsys.readouterr().err.startswith("atlantis_exp: run=latest: ")


def test_an_export_neither_overwrites_nor_starts_without_weights(
    tiny: Compose, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tiny("evaluation.at_end=false", "evaluation.every_steps=null", "phase.quick.steps=40")
    train(config)
    outputs = f"paths.outputs={config.paths.outputs}"
    assert run(monkeypatch, export, outputs, f"to={tmp_path}/new") == 1
    assert "so no best weights" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
    assert run(monkeypatch, export, outputs, "weights=latest", f"to={tmp_path}") == 2
    assert capsys.readouterr().err == f"atlantis_exp: to={tmp_path}: is not empty; name another folder\n"


def test_weights_are_packed_in_half_precision_only_where_they_have_to_be() -> None:
    def file(megabytes: float) -> bytes:
        count = int(megabytes * 250_000)
        return safetensors.numpy.save({"w": np.linspace(-1, 1, count, dtype=np.float32), "n": np.array([3])})

    assert pack(file(7.9)) == (file(7.9), "float32")
    packed, precision = pack(file(15.9))
    assert precision == "float16"
    assert len(packed) <= MOST_BYTES == 8_000_000
    arrays = safetensors.numpy.load(packed)
    assert arrays["w"].dtype == np.float16
    assert arrays["n"].tolist() == [3]
    with pytest.raises(Fault, match=r"16,100,1.. bytes in half precision; an export has 8,000,000 at most"):
        pack(file(32.2))


def test_a_card_holds_nothing_of_the_machine_and_all_of_the_science(tiny: Compose) -> None:
    config = tiny("env.workers=1", "tracking.uri=http://10.0.0.1:5000")
    card = portable(config)
    assert card.science() == config.science()
    assert card.identity() == config.identity()
    assert (card.env.workers, card.tracking.uri, card.threads, card.paths.outputs) == (None, None, None, "outputs")
    assert parse(Config, to_dict(card)) == card
