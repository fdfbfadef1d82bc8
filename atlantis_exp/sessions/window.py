"""Open a window for a person to play in."""

import os
from typing import TYPE_CHECKING

from atlantis_exp.faults import Fault
from atlantis_exp.games import Game

if TYPE_CHECKING:
    from atlantis_exp.game.preprocessing import Pixels


class Window:
    """A pygame window that shows screens at the game's speed and reads actions from the keys. Raises: Fault."""

    def __init__(self, title: str, game: Game, steps_per_second: float, scale: int) -> None:
        try:
            import pygame
        except ImportError:
            raise Fault("play needs pygame: pip install 'atlantis-exp[play]'") from None
        self._pygame = pygame
        try:
            pygame.display.init()
            self._surface = pygame.display.set_mode((160 * scale, 210 * scale))
        except pygame.error as error:
            raise Fault(f"play needs a screen: {error}") from None
        # Without a screen SDL silently draws into memory.
        if "SDL_VIDEODRIVER" not in os.environ and pygame.display.get_driver() in ("offscreen", "dummy"):
            raise Fault("play needs a screen: none was found")
        pygame.display.set_caption(f"{title}: {game.keys_in_words}")
        try:
            self._actions = {  # in the order of precedence
                pygame.key.key_code(key): game.actions.index(action)
                for key, action in game.keys
                if action in game.actions
            }
        except ValueError:
            raise Fault(f"play: pygame does not know all keys of {game.rom}: {', '.join(dict(game.keys))}") from None
        self._clock = pygame.time.Clock()
        self._steps_per_second = steps_per_second
        self.closed = False

    def choose(self, screen: "Pixels") -> int:
        """Show a screen, (210, 160, 3) uint8, for one step; return the action of the keys pressed meanwhile."""
        pygame = self._pygame
        picture = pygame.surfarray.make_surface(screen.swapaxes(0, 1))
        self._surface.blit(pygame.transform.scale(picture, self._surface.get_size()), (0, 0))
        pygame.display.flip()
        self._clock.tick(self._steps_per_second)
        events = pygame.event.get()
        self.closed = self.closed or any(event.type == pygame.QUIT for event in events)
        tapped = {event.key for event in events if event.type == pygame.KEYDOWN}
        held = pygame.key.get_pressed()
        return next((action for key, action in self._actions.items() if key in tapped or held[key]), 0)

    def close(self) -> None:
        self._pygame.display.quit()
