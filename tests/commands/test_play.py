"""A person at the keyboard, whose window is SDL's dummy screen here."""

import csv
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hydra import compose, initialize_config_dir

from atlantis_exp.commands.app import CONF, checked
from atlantis_exp.commands.play import Window, play
from atlantis_exp.comparison.gather import gather
from atlantis_exp.config import PlayConfig
from atlantis_exp.faults import Fault

BLACK = np.zeros((210, 160, 3), np.uint8)


@pytest.fixture
def pygame(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    return pytest.importorskip("pygame")


def composed(outputs: Path, *overrides: str) -> PlayConfig:
    short = ("player=ann", "env.max_steps=20", "evaluation.video=false", "tracking=none", f"paths.outputs={outputs}")
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return checked(PlayConfig, compose("play", [*short, *overrides]))


def press(pygame: Any, key: int) -> None:
    pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=key))


def test_a_key_pressed_between_two_steps_is_an_action_and_no_key_is_none(pygame: Any) -> None:
    window = Window(1_000, 1)
    for key, action in (
        (pygame.K_LEFT, 3),
        (pygame.K_RIGHT, 2),
        (pygame.K_UP, 1),
        (pygame.K_SPACE, 1),
        (pygame.K_a, 0),
    ):
        press(pygame, key)
        assert window.choose(BLACK) == action
        assert window.choose(BLACK) == 0
    window.close()


def test_the_window_shows_the_whole_screen_upright_and_scaled(pygame: Any) -> None:
    window = Window(1_000, 2)
    screen = BLACK.copy()
    screen[200, 10] = (255, 0, 0)
    window.choose(screen)
    shown = pygame.display.get_surface()
    assert shown.get_size() == (320, 420)
    assert shown.get_at((20, 400))[:3] == (255, 0, 0)
    assert shown.get_at((20, 20))[:3] == (0, 0, 0)
    window.close()


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
        play(composed(tmp_path))
    assert "high score: " in capsys.readouterr().out
    names = ["human-ann-Atlantis-v0-1", "human-ann-Atlantis-v0-2"]
    assert sorted(path.name for path in (tmp_path / "runs").iterdir()) == names
    with open(tmp_path / "runs" / names[0] / "artifacts/evaluation/episodes.csv") as file:
        (row,) = csv.DictReader(file)
    assert (row["steps"], row["LEFTFIRE"], row["LEFTFIRE_random"], row["truncated"]) == ("20", "20", "0", "1")
    assert [player.config["player"] for player in gather(tmp_path).players] == ["ann", "ann"]


def test_the_game_runs_at_60_frames_a_second(pygame: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    speeds = []
    monkeypatch.setattr(
        pygame.time, "Clock", lambda: type("Clock", (), {"tick": lambda _, speed: speeds.append(speed)})()
    )
    play(composed(tmp_path))
    play(composed(tmp_path, "env=atlantis_v5", "env.max_steps=3"))
    assert speeds == [20] * 20 + [15] * 3  # steps of 2, 3 or 4 frames, and of 4


def test_closing_the_window_ends_the_run_and_records_nothing(pygame: Any, tmp_path: Path) -> None:
    pygame.display.init()
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    with pytest.raises(Fault, match="closed before the last episode ended"):
        play(composed(tmp_path))
    assert not (tmp_path / "runs").exists()


def test_without_pygame_one_line_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(Fault, match=r"play needs pygame: pip install 'atlantis-exp\[play\]'"):
        play(composed(tmp_path))
