"""Define the facts of a game; worker processes import this, so it imports nothing heavy."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

SCREEN = (210, 160)  # rows, columns of the emulator's screen


@dataclass(frozen=True)
class Game:
    """The facts of a game of ALE: class attributes of a component of the kind `env`.

    Reports leave out missing facts: parts of a score, published players, human-normalised scores.
    """

    rom: str = ""  # ALE's name of the game, and the component's
    points: Callable[[int, Any], Sequence[float]] | None = None  # splits a frame's reward by source, given RAM
    actions: tuple[str, ...] = ()  # ALE's minimal action set, in its order
    score_range: tuple[float, float] = (0.0, 0.0)  # the axis of histograms; logarithmic if it begins above 0
    episode_steps: int = 1_000  # about, of a random player
    sources: tuple[str, ...] = ()  # of points
    sources_in_words: str = ""
    random_score: float = float("nan")  # of the published random player (Quan and Ostrovski, dqn_zoo/atari_data.py)
    human_score: float = float("nan")  # of the published human; the same table
    published_in_words: str = ""  # a remark on published scores
    held_score: float = float("nan")  # of a player that repeats one action
    early_frames: int = 0  # of training; until then published agents score near or below the random player
    early_scores: str = ""  # their scores until then, in words
    keys: tuple[tuple[str, str], ...] = (  # pygame's key and its action, by precedence
        *(("left", "LEFT"), ("right", "RIGHT"), ("up", "UP"), ("down", "DOWN")),
        ("space", "FIRE"),
    )
    keys_in_words: str = "arrow keys move, space fires"

    @property
    def is_logarithmic(self) -> bool:
        """Whether scores are shown on a logarithmic axis."""
        return self.score_range[0] > 0
