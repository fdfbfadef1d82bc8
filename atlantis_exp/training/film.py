"""Film: an episode played again from its seed and actions, with who decided what next to the screen."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atlantis_exp.game.emulator import ACTIONS, Emulator
from atlantis_exp.game.preprocessing import FrameStack
from atlantis_exp.media import film, scene
from atlantis_exp.training.actor import Actor, EpsilonGreedy, States
from atlantis_exp.training.evaluation import Episode

QValues = Callable[[States], npt.NDArray[np.float32]]


class Moment(NamedTuple):
    """What was on screen before a step of an episode, and what was decided on it; at the end nothing was."""

    screen: npt.NDArray[np.uint8]  # (210, 160, 3)
    score: float  # so far
    frame: int  # so far
    action: int | None
    random: bool
    q_values: npt.NDArray[np.float32] | None  # (actions,), what the network thought of them even where chance chose


def moments(episode: Episode, emulator: Emulator, stack: int, q_values: QValues | None = None) -> Iterator[Moment]:
    """Play an episode again from its seed and actions; stack in observations, as the network wants its states."""
    observation = emulator.reset(episode.seed)
    stacks = FrameStack(1, observation.shape[0], stack)
    stacks.reset([0], observation[np.newaxis])
    score, frame = 0.0, 0
    for action, random in zip(episode.actions, episode.random, strict=True):
        values = None if q_values is None else q_values(stacks.state)[0]
        yield Moment(emulator.screen_rgb(), score, frame, action, bool(random), values)
        step = emulator.step(action)
        stacks.push(step.observation[np.newaxis])
        score += step.reward
        frame += step.frames
    yield Moment(emulator.screen_rgb(), score, frame, None, False, None)


def greedy_moments(seed: int, emulator: Emulator, stack: int, q_values: QValues) -> Iterator[Moment]:
    """Play an episode by the network's best actions alone; stack in observations, as the network wants its states."""
    observation = emulator.reset(seed)
    stacks = FrameStack(1, observation.shape[0], stack)
    stacks.reset([0], observation[np.newaxis])
    score, frame, over = 0.0, 0, False
    while not over:
        values = q_values(stacks.state)[0]
        action = int(values.argmax())
        yield Moment(emulator.screen_rgb(), score, frame, action, False, values)
        step = emulator.step(action)
        stacks.push(step.observation[np.newaxis])
        score += step.reward
        frame += step.frames
        over = step.terminated or step.truncated
    yield Moment(emulator.screen_rgb(), score, frame, None, False, None)


def film_episode(episode: Episode, actor: Actor, emulator: Emulator, stack: int) -> bytes:
    """An mp4 of an episode at the game's own speed of 60 frames a second, on average, with who decided what."""
    chooser = "network" if isinstance(actor, EpsilonGreedy) else "constant player"
    q_values = actor.q_values if isinstance(actor, EpsilonGreedy) else None

    def pictures() -> Iterator[npt.NDArray[np.uint8]]:
        for step, moment in enumerate(moments(episode, emulator, stack, q_values)):
            lines = (f"step {step:,} of {episode.steps:,}", f"score {moment.score:,.0f} of {episode.score:,.0f}")
            source = "random" if moment.random else chooser
            yield scene(moment.screen, lines, source, ACTIONS, moment.action, moment.q_values)

    return film(pictures(), 60 * episode.steps / episode.frames)
