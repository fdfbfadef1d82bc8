"""The facts of a game that the package uses; worker processes import this, so it imports nothing heavy."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Game:
    """The facts of a game of ALE: class attributes of a component of the kind `env`.

    Facts that are missing are left out of reports: parts of a score, published players, human-normalised scores.
    """

    rom: str = ""  # ALE's name of it, which is the component's
    points: Callable[[int, Any], Sequence[float]] | None = None  # a frame's reward and the RAM to parts, as `sources`
    actions: tuple[str, ...] = ()  # ALE's minimal action set, in its order
    score_range: tuple[float, float] = (0.0, 0.0)  # the axis of histograms; logarithmic where it begins above 0
    episode_steps: int = 1_000  # of a random player, about
    sources: tuple[str, ...] = ()  # of points
    sources_in_words: str = ""
    random_score: float = float("nan")  # of the published random player (Quan and Ostrovski, dqn_zoo/atari_data.py)
    human_score: float = float("nan")  # of the published human; the same table
    published_in_words: str = ""  # a remark on published scores
    held_score: float = float("nan")  # of any one action, held
    early_frames: int = 0  # of training, up to which published agents stay below the random player or near it
    early_scores: str = ""  # in words, their scores then
    keys: tuple[tuple[str, str], ...] = (  # pygame's name of a key to an action, in the order of precedence
        *(("left", "LEFT"), ("right", "RIGHT"), ("up", "UP"), ("down", "DOWN")),
        ("space", "FIRE"),
    )
    keys_in_words: str = "arrow keys move, space fires"

    @property
    def is_logarithmic(self) -> bool:
        """Whether scores are shown on a logarithmic axis."""
        return self.score_range[0] > 0
