"""A game: Breakout on ALE. Nothing presses FIRE for the player: only a chosen FIRE starts a ball."""

from atlantis_exp.components import component


@component("breakout", "env")
class Breakout:
    """Each of five balls is a life; bricks score 1, 4 or 7 points, 864 in all."""

    actions = ("NOOP", "FIRE", "RIGHT", "LEFT")
    score_range = (0.0, 864.0)
    episode_steps = 200  # of a random player, at four frames a step
    random_score = 1.7
    human_score = 30.5
    keys_in_words = "left and right move, space starts a ball"
