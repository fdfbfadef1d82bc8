"""Draw `docs/images/crop.png`: the crop on a real frame, and the networks' views of it.

`python docs/make_crop_picture.py`, from the root of the checkout; the same picture at every call.
"""

import dataclasses
from pathlib import Path

import numpy as np
from hydra import compose, initialize_config_dir
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from atlantis_exp.build import make_emulator
from atlantis_exp.commands import CONF
from atlantis_exp.commands.composing import checked
from atlantis_exp.commands.query import QueryConfig
from atlantis_exp.game.atlantis import Atlantis

SIZES = (84, 159)  # of DQNCnn and ResNetDQN, pixels
LANES = (19, 40, 61, 82)  # first rows of the ships' lanes
STEPS = 175  # of random play, until ships appear


def main() -> None:
    """Play, and draw the frame beside its two observations."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        env = checked(QueryConfig, compose("query")).env
    up, right, down, left = env.crop
    actions = np.random.default_rng(0).integers(len(Atlantis.actions), size=STEPS)
    observations = []
    for size in SIZES:
        emulator = make_emulator(dataclasses.replace(env, size=size))()
        emulator.reset(seed=0)
        observations.append([emulator.step(action).observation for action in actions.tolist()][-1])

    figure = Figure(figsize=(11, 4.6), dpi=100, layout="constrained")
    whole, *seen = figure.subplots(1, 3)
    whole.imshow(emulator.screen_rgb())
    whole.add_patch(Rectangle((left, up), right - left - 1, down - up, fill=False, edgecolor="yellow", linewidth=2))
    for number, lane in enumerate(LANES, start=1):
        whole.axhline(lane, color="white", linewidth=0.5, linestyle=":")
        whole.annotate(f"lane {number}: row {lane}", (2, lane - 1), color="white", fontsize=6)
    whole.set_title(f"crop [{up}, {right}, {down}, {left}]: rows {up}-{down - 1}")
    for axes, size, observation in zip(seen, SIZES, observations, strict=True):
        axes.imshow(observation, cmap="gray", vmin=0, vmax=255)
        axes.set_title(f"{size}x{size}")
    figure.savefig(Path(__file__).parent / "images" / "crop.png", metadata={"Software": None})


if __name__ == "__main__":
    main()
