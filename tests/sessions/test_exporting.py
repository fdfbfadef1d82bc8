"""Exported weights: what a folder of them holds, and when there is none."""

import json
import re
import resource
import shlex
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
import safetensors.torch
import torch
import yaml

from atlantis_exp.build import build_network
from atlantis_exp.comparison.choosing import group, plays_alike
from atlantis_exp.comparison.gather import gather
from atlantis_exp.comparison.tables import compare
from atlantis_exp.comparison.verdict import Question
from atlantis_exp.config import Config
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.sessions import cards, exporting, onnx
from atlantis_exp.sessions.cards import build_exported_actor, read_card
from atlantis_exp.sessions.job import Job, replaced
from atlantis_exp.sessions.training import train
from atlantis_exp.terminal import quoted
from atlantis_exp.training.actor import EpsilonGreedy
from atlantis_exp.training.trainer import Trainer

Command = Callable[..., int]
Compose = Callable[..., Config]


@pytest.fixture(scope="module")
def once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for what is trained only once."""
    return tmp_path_factory.mktemp("once")


@pytest.fixture
def trained(tiny: Compose, once: Path, tmp_path: Path) -> Path:
    """The outputs folder of a training with evaluations at steps 80 and 160."""
    if not (once / "runs").exists():
        train(Job(tiny("env.max_steps=200", f"paths.outputs={once}")))
    shutil.copytree(once, tmp_path, dirs_exist_ok=True)
    return tmp_path


@pytest.fixture
def exported(command: Command, trained: Path, tmp_path: Path) -> Path:
    """The folder of an exported network."""
    folder = tmp_path / "pretrained" / "tiny"
    assert command("export", f"to={folder}", "episodes=1", f"paths.outputs={trained}", "device=cpu") == 0
    return folder


def test_an_exports_folder_is_typed_as_in_a_shell_and_is_not_the_one_that_it_is_in(
    command: Command, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    shared = (f"paths.outputs={trained}", "device=cpu", "episodes=1")
    assert command("export", "to=.", *shared) == 2
    assert capsys.readouterr().err == "atlantis_exp: to=.: the folder that you are in; name another\n"
    assert command("export", "to=x/..", *shared) == 2
    (tmp_path / "empty").mkdir()
    (tmp_path / "here").symlink_to("empty")
    assert command("export", "to='~/here'", *shared) == 0
    assert (tmp_path / "here" / "card.json").exists()
    assert command("evaluate", "weights='~/here'", *shared, "tracking=none") == 0


def test_a_training_begins_with_exported_weights_also_where_it_was_killed_before_its_first_commit(
    tiny: Compose, exported: Path, tmp_path: Path
) -> None:
    config = tiny("seed=1", "training.ema=10", f"training.weights={exported}", f"paths.outputs={tmp_path / 'second'}")
    RunFolder.of(config).path.mkdir(parents=True)
    RunFolder.of(config).write_config({})  # as a kill leaves it
    _, content = read_card(exported)
    expected = safetensors.numpy.load(content)
    looks = []

    def watch(trainer: Trainer) -> bool:
        if trainer.learner.updates == 0:
            for network in (trainer.learner.network, trainer.learner.target, trainer.learner.evaluated):
                made = {name: tensor.numpy() for name, tensor in network.state_dict().items()}
                assert made.keys() == expected.keys()
                assert all((made[name] == expected[name].astype(np.float32)).all() for name in expected)
        looks.append(trainer.counters.steps)
        return len(looks) == 9

    train(Job(config), watch)
    shutil.rmtree(exported)  # a run that has a commit is its own
    train(Job(config), watch)
    assert [*dict.fromkeys(looks)] == [*range(161)]  # in evaluations, too
    assert RunFolder.of(config).state == "done"


@pytest.mark.slow
def test_an_export_of_what_began_with_weights_says_which_and_not_where(
    command: Command, tiny: Compose, exported: Path, tmp_path: Path
) -> None:
    config = tiny("seed=1", f"training.weights={exported}", f"paths.outputs={tmp_path / 'second'}")
    train(Job(config))
    folder = tmp_path / "again"
    assert command("export", f"to={folder}", "episodes=1", f"paths.outputs={tmp_path / 'second'}", "device=cpu") == 0
    first, _ = read_card(exported)
    second, _ = read_card(folder)
    assert second.config.training.weights == f"tiny@{first.sha256[:16]}"
    assert str(tmp_path) not in (folder / "card.json").read_text()
    gathered = gather(tmp_path / "second")
    notes = compare(gathered, group(gathered.trainings, ["model"]), Question(["model"])).notes
    assert f"cnn began with {config.training.weights}; frames, hours and FLOPs do not include their training." in notes


def test_weights_that_no_training_can_begin_with_are_one_line_and_leave_nothing(
    command: Command,
    tiny_overrides: tuple[str, ...],
    exported: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def refused(*words: str) -> str:
        assert command(*replaced(tiny_overrides, f"paths.outputs={tmp_path / 'second'}", *words)) == 2
        assert not (tmp_path / "second").exists()
        return capsys.readouterr().err.removeprefix(f"atlantis_exp: training.weights={exported}")

    capsys.readouterr()
    digest = read_card(exported)[0].sha256[:16]
    assert refused(f"training.weights={exported}x") == (
        f"x: not a folder of exported weights; did you mean '{exported}'? (valid: {exported})\n"
    )
    assert refused(f"training.weights='{exported}@{16 * '0'}'") == f"@{16 * '0'}: its weights are @{digest}\n"
    theirs = ": weights of another network (model=cnn, env.size=40, dqn)\n"
    assert refused(f"training.weights={exported}", "model=resnet_fast") == theirs
    assert refused(f"training.weights='{exported}@{digest}'", "env.size=44") == theirs
    (exported / "card.json").write_text("{}")
    assert "card.json" in refused(f"training.weights={exported}")


@pytest.mark.slow
def test_a_page_says_that_a_network_learned_in_another_precision_than_it_plays_in(
    command: Command, tiny: Compose, tmp_path: Path
) -> None:
    config = tiny("training.precision=bf16", "env.max_steps=200")
    train(Job(config))
    folder = tmp_path / "pretrained" / "tiny"
    assert command("export", f"to={folder}", "episodes=1", f"paths.outputs={config.paths.outputs}", "device=cpu") == 0
    page = (folder / "README.md").read_text()
    assert "this folder, in float32; it learned in bfloat16, in which it may choose otherwise.\n" in page


def test_exported_weights_score_what_their_card_says(
    command: Command, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In half precision, which is what this limit takes."""
    monkeypatch.setattr(cards, "SINGLE", 300_000)
    folder = tmp_path / "pretrained" / "it's, tiny"
    outputs = (f"paths.outputs={trained}", "device=cpu")
    made = (f"to={quoted(folder)}", "episodes=3", "epsilon=0.9", "evaluation.num_envs=1")
    assert command("export", *made, *outputs) == 0

    card, weights = read_card(folder)
    assert card.precision == "float16"
    best = safetensors.numpy.load_file(next(trained.glob(f"runs/*/artifacts/models/network/{card.step}.safetensors")))
    for name, array in safetensors.numpy.load(weights).items():
        np.testing.assert_array_equal(array, best[name].astype(np.float16))
    (trained_step,) = {int(path.stem) for path in trained.glob("runs/*/artifacts/evaluation/*.csv")} & {card.step}
    assert (card.weights, trained_step) == ("best", card.step)
    assert card.reached["frames"] >= 2 * card.step
    assert len(card.scores) == 3
    assert len(set(card.scores)) > 1
    page = (folder / "README.md").read_text()
    metadata = yaml.safe_load(page.split("---\n")[1])
    assert (metadata["license"], metadata["tags"][-1]) == ("mit", "cnn")
    (result,) = metadata["model-index"][0]["results"]
    assert result["metrics"][0]["value"] == f"{np.mean(card.scores):.2f} +/- {np.std(card.scores):.2f}"
    assert card.sha256 in page
    assert f"| {np.mean(card.scores):,.0f} |" in page
    assert "this folder, in float32.\n" in page
    assert not any(str(trained) in path.read_text() for path in (folder / "README.md", folder / "card.json"))

    capsys.readouterr()
    monkeypatch.chdir(folder.parent)
    (line,) = re.findall(r"^ +(.* atlantis_exp evaluate .*)  # plays the episodes below$", page, re.MULTILINE)
    played = (*shlex.split(line)[4:], *outputs, "tracking=none")
    assert command("evaluate", *played) == 0
    table = [[cell.strip() for cell in line.split("│")] for line in capsys.readouterr().out.splitlines()]
    rows = {row[1]: row[2:-1] for row in table if len(row) > 3}
    assert rows["card"] == rows["here"]
    assert rows["card"][-3:] == ["3", "0.9", "2000003"]
    (recorded,) = (trained / "evaluations").iterdir()
    facts = json.loads((recorded / "config.json").read_text())
    assert (facts["sha256"], facts["evaluation"]["num_envs"]) == (card.sha256, 1)
    film = recorded / "artifacts" / "best_episode.mp4"
    assert film.stat().st_size > 1_000

    # What was trained here is shown with them where they played the same game at the same epsilon.
    assert command("evaluate", *played, "epsilon=0.05", "episodes=2", "evaluation.video=false") == 0
    gathered = gather(trained)
    (training,) = gathered.trainings
    alike = {player.config["evaluation.epsilon"]: plays_alike(player, [training]) for player in gathered.players}
    assert alike == {0.9: False, 0.05: True}
    assert {player.called for player in gathered.players} == {"weights it's, tiny"}
    comparison = compare(gathered, group(gathered.trainings, ["model"]), Question(["model"]))
    assert re.search(r"In the same game, on average: weights it's, tiny [\d,]+\.", " ".join(comparison.notes))


def test_an_export_neither_overwrites_nor_starts_without_weights(
    command: Command, tiny: Compose, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tiny("evaluation.at_end=false", "evaluation.every_steps=null", "phase.quick.steps=40")
    train(Job(config))
    outputs = f"paths.outputs={config.paths.outputs}"
    assert command("export", outputs, f"to={tmp_path}/new") == 1
    assert "so no best weights" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
    assert command("export", outputs, "weights=latest", f"to={tmp_path}") == 2
    assert capsys.readouterr().err == f"atlantis_exp: to={tmp_path}: is not empty; name another folder\n"
    (tmp_path / "file").touch()
    assert command("export", outputs, "weights=latest", f"to={tmp_path}/file") == 2
    assert capsys.readouterr().err == f"atlantis_exp: to={tmp_path}/file: is not empty; name another folder\n"


@pytest.mark.slow
def test_an_export_to_a_full_disk_is_one_line_and_leaves_nothing(
    command: Command, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("export", f"to={tmp_path}/new", "episodes=1", f"paths.outputs={trained}", "device=cpu")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))  # bytes, fewer than the weights have
    try:
        assert command(*words) == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    error = capsys.readouterr().err
    assert error.startswith(f"atlantis_exp: to={tmp_path}/new: [Errno 27] File too large")
    assert error.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == {"runs"}
    assert command(*words) == 0
    assert read_card(tmp_path / "new")[0].run


def test_an_export_that_is_terminated_leaves_nothing(
    command: Command, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def end(*_: object) -> None:
        assert [*tmp_path.glob(".aside-*/new")]
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(exporting, "build_evaluator", end)
    assert command("export", f"to={tmp_path}/new", f"paths.outputs={trained}", "device=cpu") == 143
    assert not [*tmp_path.glob("*new*"), *tmp_path.glob(".aside-*")]


@pytest.mark.parametrize(
    ("command_of_the_run", "kept"),
    [
        ("python -m atlantis_exp train 'paths.outputs=/home/me/my thesis/a' model=cnn", "model=cnn"),
        ("python -m atlantis_exp train '+tracking.uri=http://a b' seed=1 tracking=none", "seed=1 tracking=none"),
        (
            "python -m atlantis_exp train 'plugins=/home/me/my nets/a.py,~/b/c.py,../d.py'",
            "plugins=./a.py,./c.py,./d.py",
        ),
        ("python -m atlantis_exp train 'training.weights=/home/my me/cnn@0a'", "training.weights=./cnn@0a"),
        ("python -m atlantis_exp train '--config-dir=/home/my me/conf'", "--config-dir=./conf"),
        ("python -m atlantis_exp train env.id=ALE/Atlantis-v5 'x=[1, 2]'", "env.id=ALE/Atlantis-v5 'x=[1, 2]'"),
    ],
)
def test_an_exported_command_names_no_place_of_this_machine(command_of_the_run: str, kept: str) -> None:
    assert exporting._without_places(command_of_the_run) == f"python -m atlantis_exp train {kept}"


def test_why_a_network_cannot_be_onnx_is_said_whole_and_without_colours(
    tiny: Compose, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise torch.onnx.OnnxExporterError("\x1b[96m[torch.onnx]\x1b[0m failed\n\nSize must be a multiple of 7")

    monkeypatch.setattr(torch.onnx, "export", fail)
    config = tiny()
    weights = safetensors.torch.save(build_network(config, "network").state_dict())
    with pytest.raises(Fault, match=r"as ONNX: \[torch\.onnx\] failed Size must be a multiple of 7$"):
        onnx.export_onnx(config, weights)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["cnn", "cnn_norm", "resnet", "resnet_fast", "cnn_small"])
def test_a_network_as_onnx_says_what_it_says_in_torch(
    command: Command, tiny: Compose, tmp_path: Path, capsys: pytest.CaptureFixture[str], model: str
) -> None:
    onnxruntime = pytest.importorskip("onnxruntime", reason="the extra onnx is not installed")
    config = tiny(
        f"model={model}", "env.size=40", "env.stack=[0,1,3,8]", "objective=quantile", "evaluation.at_end=false"
    )
    train(Job(config))
    folder, outputs = tmp_path / "exported", f"paths.outputs={config.paths.outputs}"
    assert command("export", f"to={folder}", "weights=latest", "episodes=1", "onnx=true", outputs) == 0
    assert re.search(r"network\.onnx: within \S+ of torch's values in \d{2,} states", capsys.readouterr().out)
    assert "network.onnx" in (folder / "README.md").read_text()
    card, weights = read_card(folder)
    states = np.random.default_rng(0).integers(0, 256, (3, 4, 40, 40), np.uint8)
    session = onnxruntime.InferenceSession(folder / "network.onnx", providers=["CPUExecutionProvider"])
    (values,) = session.run(None, {"states": states})
    actor = build_exported_actor(card.config, weights, "cpu")
    assert isinstance(actor, EpsilonGreedy)
    np.testing.assert_allclose(values, actor.q_values(states), rtol=1e-4, atol=1e-5)


def test_a_network_with_a_memory_is_not_written_as_onnx(tiny: Compose) -> None:
    config = tiny("model=cnn_gru")
    weights = safetensors.torch.save(build_network(config, "network").state_dict())
    with pytest.raises(ConfigError, match="onnx=true: model=cnn_gru has a memory"):
        onnx.export_onnx(config, weights)


def test_onnx_without_its_extra_is_one_line(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(onnx, "find_spec", lambda _: None)
    assert command("export", "onnx=true", f"paths.outputs={tmp_path}") == 2
    assert capsys.readouterr().err == "atlantis_exp: onnx=true: needs pip install 'atlantis-exp[onnx]'\n"
