"""A game: Pong on ALE. Its score, points won less points lost, may be negative; a game ends at 21."""

from collections.abc import Sequence

from atlantis_exp.components import component


@component("pong", "env")
class Pong:
    """Pong has no lives; RIGHT is up."""

    actions = ("NOOP", "FIRE", "RIGHT", "LEFT", "RIGHTFIRE", "LEFTFIRE")
    score_range = (-21.0, 21.0)
    episode_steps = 900  # of a random player, at four frames a step
    sources = ("won", "lost")
    sources_in_words = "points won and points lost"
    keys = (("up", "RIGHT"), ("down", "LEFT"), ("space", "FIRE"))
    keys_in_words = "up and down move"

    @staticmethod
    def points(reward: int, ram: Sequence[int]) -> Sequence[float]:
        """Split a frame's reward by `sources`; `ram` is the console's 128 bytes after the frame."""
        return max(reward, 0), min(reward, 0)
