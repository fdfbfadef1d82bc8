"""The window of a person who plays, on SDL's dummy screen."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from atlantis_exp.components import facts_of, game_of
from atlantis_exp.faults import Fault
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


def test_without_a_screen_nobody_plays(pygame: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SDL_VIDEODRIVER")
    monkeypatch.setattr(pygame.display, "get_driver", lambda: "offscreen")
    with pytest.raises(Fault, match=r"^play needs a screen"):
        Window("Atlantis", facts_of(game_of("Atlantis-v0")), 1_000, 1)
    pygame.display.quit()


@pytest.mark.usefixtures("pygame")
def test_a_key_that_pygame_does_not_know_is_named() -> None:
    game = replace(facts_of(game_of("Atlantis-v0")), keys=(("uparrow", "FIRE"),))
    with pytest.raises(Fault, match=r"^play: pygame does not know all keys of atlantis: uparrow$"):
        Window("Atlantis", game, 1_000, 1)


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
