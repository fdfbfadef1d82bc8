"""Draw `docs/images/game.png`: two moments of a game of the shipped DQNCnn, as its film shows them.

`python docs/make_game_picture.py`, from the root of the checkout; the same picture at every call on the same processor.
"""

import dataclasses
from pathlib import Path

import cv2
import numpy as np

from atlantis_exp.build import make_emulator
from atlantis_exp.game.atlantis import Atlantis
from atlantis_exp.game.vector import make_emulators
from atlantis_exp.media import scene
from atlantis_exp.sessions.cards import build_exported_actor, read_card
from atlantis_exp.training.evaluation import evaluate
from atlantis_exp.training.film import Moment, moments

STEPS = 1_500  # to play


def main() -> None:
    """Play, and draw the latest decisions of the network and of chance, left and right."""
    card, weights = read_card(Path("pretrained/cnn_fast"))
    env = dataclasses.replace(card.config.env, max_steps=STEPS, workers=1)
    actor = build_exported_actor(card.config, weights, "cpu")
    with make_emulators(make_emulator(env), 1, 1) as emulators:
        protocol = {"epsilon": card.evaluation.epsilon, "seed": 0, "size": env.size, "lags": env.lags}
        (episode,) = evaluate(actor, emulators, episodes=1, **protocol).episodes  # type: ignore[arg-type]
    latest: dict[bool, tuple[int, Moment]] = {}
    for step, moment in enumerate(moments(episode, make_emulator(env)())):
        if moment.action not in (None, 0):  # something happens
            latest[moment.random] = step, moment
    pictures = []
    for is_random, source in ((False, "network"), (True, "random")):
        step, moment = latest[is_random]
        lines = (f"step {step:,}", f"score {moment.score:,.0f}")
        pictures.append(scene(moment.screen, lines, source, Atlantis.actions, moment.action, moment.q_values))
    cv2.imwrite("docs/images/game.png", cv2.cvtColor(np.hstack(pictures), cv2.COLOR_RGB2BGR))


if __name__ == "__main__":
    main()
