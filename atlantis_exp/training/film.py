"""Film an episode by playing it again, and show each decision next to the screen."""

from collections.abc import Callable, Iterator
from itertools import islice
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from atlantis_exp.game.emulator import Emulator
from atlantis_exp.media import film, scene
from atlantis_exp.training.evaluation import Episode

Part = Literal["first_minute", "best_minute", "all"]

FRAMES_A_MINUTE = 3_600  # of the game


class Moment(NamedTuple):
    """The screen before a step of an episode, and the decision; None at the end."""

    screen: npt.NDArray[np.uint8]  # (210, 160, 3)
    score: float  # so far
    action: int | None
    random: bool
    q_values: npt.NDArray[np.float32] | None  # (actions,), the network's, even if chance chose


def moments(episode: Episode, emulator: Emulator, start: int = 0) -> Iterator[Moment]:
    """Play an episode again from its seed and actions; yield its moments from step `start` on."""
    emulator.reset(episode.seed)
    values = episode.values
    score = 0.0
    for index, (action, random) in enumerate(zip(episode.actions, episode.random, strict=True)):
        if index >= start:
            q_values = None if values is None else values[index]
            yield Moment(emulator.screen_rgb(), score, action, bool(random), q_values)
        step = emulator.step(action)
        score += step.reward
    yield Moment(emulator.screen_rgb(), score, None, False, None)


def span(episode: Episode, part: Part) -> tuple[int, int]:
    """Return the first step of a part of an episode and the one after its last, by average steps a minute."""
    minute = round(FRAMES_A_MINUTE * episode.steps / episode.frames)
    if part == "all" or minute >= episode.steps:
        return 0, episode.steps
    if part == "first_minute":
        return 0, minute
    earned = np.concatenate([[0.0], np.cumsum(episode.rewards)])  # before each step
    start = int(np.argmax(earned[minute:] - earned[:-minute]))
    return start, start + minute


def film_episode(
    episode: Episode, emulator: Emulator, part: Part, tell: Callable[[int, int], None] = lambda *_: None
) -> bytes:
    """Return an mp4 of a part of an episode at the game's speed: 60 frames a second, on average.

    Calls `tell` with the number of drawn pictures and of all.
    """
    chooser = "player" if episode.values is None else "network"
    start, end = span(episode, part)

    def pictures() -> Iterator[npt.NDArray[np.uint8]]:
        for index, moment in enumerate(islice(moments(episode, emulator, start), end - start + 1)):
            tell(index, end - start)
            step, score = f"step {start + index:,} of {episode.steps:,}", f"score {moment.score:,.0f}"
            lines = step, f"{score} of {episode.score:,.0f}"
            source = "random" if moment.random else chooser
            yield scene(moment.screen, lines, source, emulator.game.actions, moment.action, moment.q_values)

    return film(pictures(), 60 * episode.steps / episode.frames)
