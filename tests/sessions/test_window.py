"""The window of a person who plays, on SDL's dummy screen."""

from typing import Any

import numpy as np
import pytest

from atlantis_exp.components import facts_of, game_of
from atlantis_exp.sessions.window import Window

BLACK = np.zeros((210, 160, 3), np.uint8)


@pytest.fixture
def pygame(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    return pytest.importorskip("pygame")


def press(pygame: Any, key: int) -> None:
    pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=key))


def test_a_key_pressed_between_two_steps_is_an_action_and_no_key_is_none(pygame: Any) -> None:
    window = Window("Atlantis", facts_of(game_of("Atlantis-v0")), 1_000, 1)
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
    window = Window("Atlantis", facts_of(game_of("Atlantis-v0")), 1_000, 2)
    screen = BLACK.copy()
    screen[200, 10] = (255, 0, 0)
    window.choose(screen)
    shown = pygame.display.get_surface()
    assert shown.get_size() == (320, 420)
    assert shown.get_at((20, 400))[:3] == (255, 0, 0)
    assert shown.get_at((20, 20))[:3] == (0, 0, 0)
    window.close()
