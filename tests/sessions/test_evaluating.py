"""Evaluations as runs of their own: which stored run is meant, a baseline, and a person at the keyboard.

The person's window is SDL's dummy screen here.
"""

import csv
import json
import re
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import mlflow
import pytest
from hydra import compose, initialize_config_dir

from atlantis_exp.commands import CONF
from atlantis_exp.commands.baseline import BaselineConfig
from atlantis_exp.commands.composing import checked
from atlantis_exp.commands.play import PlayConfig
from atlantis_exp.comparison.gather import gather
from atlantis_exp.faults import Fault
from atlantis_exp.runs.folder import RunFolder, find_run
from atlantis_exp.sessions import evaluating
from atlantis_exp.sessions.evaluating import _held, _placeable, play, play_baseline
from atlantis_exp.sessions.reporting import report
from atlantis_exp.sessions.window import Window

Capture = pytest.CaptureFixture[str]
Command = Callable[..., int]
T = TypeVar("T")


def composed(verb: str, schema: type[T], *words: str) -> T:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return checked(schema, compose(verb, list(words)))


@pytest.fixture
def stored(tmp_path: Path) -> Path:
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
    command: Command, stored: Path, capsys: pytest.CaptureFixture[str], name: str, line: str
) -> None:
    assert command("evaluate", f"run={name}", f"paths.outputs={stored}") == 2
    error = capsys.readouterr().err
    assert error.startswith(line)
    assert error.count("\n") == 1


def test_a_run_is_found_by_a_start_with_its_seed_beside_others_and_those_put_aside(stored: Path) -> None:
    for name in ("cnn-uniform-s1-bb~1", "cnn-uniform-s10-cc"):
        shutil.copytree(stored / "runs" / "cnn-uniform-s1-bb", stored / "runs" / name)
    for name in ("cnn-uniform-s1", "cnn-uniform-s1-b", "cnn-*-s1-*", "cnn-uniform-s1-bb"):
        assert find_run(stored, name).name == "cnn-uniform-s1-bb"
    assert find_run(stored, "cnn-uniform-s1-bb~1").name == "cnn-uniform-s1-bb~1"


def test_no_run_at_all_is_one_line_and_nothing_is_created(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("evaluate", f"paths.outputs={tmp_path}/o") == 2
    assert capsys.readouterr().err == f"atlantis_exp: run=latest: {tmp_path}/o/runs has no training runs\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("damaged", ["", "{", "[]", '{"model": {}}', '{"model": {"_target_": "os.system"}}'])
@pytest.mark.thinned(3)
def test_a_damaged_config_is_one_line_that_names_its_file(
    command: Command, stored: Path, capsys: pytest.CaptureFixture[str], damaged: str
) -> None:
    path = stored / "runs/cnn-uniform-s0-aa/config.json"
    path.write_text(damaged)
    assert command("evaluate", "run=cnn-uniform-s0-aa", f"paths.outputs={stored}") in (1, 2)
    error = capsys.readouterr().err
    assert error.startswith(f"atlantis_exp: {path}")
    assert error.count("\n") == 1


@pytest.mark.parametrize("name", ["epsilon", "episodes"])
def test_epsilon_and_episodes_are_the_evaluations(
    command: Command, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    assert command("evaluate", f"{name}=-1") == 2
    assert f"evaluation.{name}=-1: should be greater than or equal to" in capsys.readouterr().err


@pytest.mark.slow
def test_a_held_button_scores_2000_and_the_run_holds_its_report_table_picture_and_film(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("agent=constant", "env.workers=1", "evaluation.episodes=2", "evaluation.num_envs=1")
    config = composed("baseline", BaselineConfig, *words, f"paths.outputs={tmp_path}")
    name = config.run_name()
    play_baseline(**vars(config), name=name, title=config.title(), command="python -m atlantis_exp baseline", cores=1)
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

    report(Path(config.paths.outputs))
    table = capsys.readouterr().out
    assert run.info.run_name == f"constant 1 Atlantis-v0 {config.identity()[:6]}"
    assert name in table
    assert "2,000" in table


@pytest.mark.parametrize("name", ["cnn_fast", "my net", "größe", "ü", "_x", ".x", "..", "a" * 300])
def test_an_evaluation_can_come_back_from_a_server_whatever_the_weights_are_called(name: str) -> None:
    assert re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.,~+=@-]{0,199}", f"{_placeable(name)}-at-{10**12}-0a1b2c")
    assert _placeable("cnn-uniform-s0-aa~1") == "cnn-uniform-s0-aa~1"


def test_a_baseline_that_is_terminated_leaves_nothing(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluating, "build_evaluator", lambda *_: signal.raise_signal(signal.SIGTERM))
    assert command("baseline", "tracking=none", f"paths.outputs={tmp_path}") == 143
    assert not [*tmp_path.glob("runs/*")]


@pytest.mark.usefixtures("pygame")
@pytest.mark.parametrize("words", ["baseline agent=constant", "play"])
def test_no_game_is_played_where_nothing_can_be_recorded(
    words: str, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setattr(evaluating, "build_evaluator", lambda *_: pytest.fail("played"))
    assert command(*words.split(), "tracking=none", f"paths.outputs={tmp_path}/file") == 2
    assert re.fullmatch(r"atlantis_exp: .*/file.*\n", capsys.readouterr().err)


@pytest.fixture
def pygame(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    return pytest.importorskip("pygame")


def press(pygame: Any, key: int) -> None:
    pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=key))


def play_composed(outputs: Path, *overrides: str) -> None:
    short = ("player=ann", "env.max_steps=20", "evaluation.video=false", "tracking=none", f"paths.outputs={outputs}")
    play(**vars(composed("play", PlayConfig, *short, *overrides)), command="python -m atlantis_exp play", cores=1)


def test_a_persons_episode_is_a_run_that_a_comparison_finds(
    pygame: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    choose = Window.choose

    def choose_left(window: Window, screen: Any) -> int:
        press(pygame, pygame.K_LEFT)
        return choose(window, screen)

    monkeypatch.setattr(Window, "choose", choose_left)
    monkeypatch.setattr(pygame.time, "Clock", lambda: type("Clock", (), {"tick": lambda *_: 0}))
    for _ in range(2):
        play_composed(tmp_path)
    printed = capsys.readouterr().out
    assert printed.startswith("ann plays Atlantis: left, up, right fire a gun each")
    assert "rand: 0.0% player: 100.0%\n" in printed
    names = ["human-ann-Atlantis-v0-1", "human-ann-Atlantis-v0-2"]
    assert sorted(path.name for path in (tmp_path / "runs").iterdir()) == names
    with open(tmp_path / "runs" / names[0] / "artifacts/evaluation/episodes.csv") as file:
        (row,) = csv.DictReader(file)
    assert (row["steps"], row["LEFTFIRE"], row["LEFTFIRE_random"], row["truncated"]) == ("20", "20", "0", "1")
    assert [player.config["player"] for player in gather(tmp_path).players] == ["ann", "ann"]


@pytest.mark.slow
def test_the_game_runs_at_60_frames_a_second(pygame: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    speeds = []
    monkeypatch.setattr(
        pygame.time, "Clock", lambda: type("Clock", (), {"tick": lambda _, speed: speeds.append(speed)})()
    )
    play_composed(tmp_path)
    play_composed(tmp_path, "env=atlantis_v5", "env.max_steps=3")
    assert speeds == [20] * 20 + [15] * 3  # steps of 2, 3 or 4 frames, and of 4


def test_closing_the_window_ends_the_run_and_records_nothing(pygame: Any, tmp_path: Path) -> None:
    pygame.display.init()
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    with pytest.raises(Fault, match="closed before the last episode ended"):
        play_composed(tmp_path)
    assert not [*tmp_path.glob("runs/*")]


def test_a_folder_that_was_there_before_an_evaluation_that_fails_stays(tmp_path: Path) -> None:
    for was_there in (True, False):
        folder = RunFolder(tmp_path / str(was_there))
        if was_there:
            folder.path.mkdir()
            (folder.path / "note.txt").write_text("mine")
        with pytest.raises(Fault), _held(folder):
            raise Fault("no game was played")
    assert (tmp_path / "True" / "note.txt").read_text() == "mine"
    assert not (tmp_path / "False").exists()


def test_without_pygame_one_line_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(Fault, match=r"play needs pygame: pip install 'atlantis-exp\[play\]'"):
        play_composed(tmp_path)
