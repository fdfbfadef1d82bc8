"""The archive: a fixed set of a game's states, on which any network that plays it can be asked.

A state is its last frames in palette indices, so that every frameskip, crop, size, pool and stack has its own view of
the same moment. `docs/make_states.py` made ours of games of the networks in `pretrained/` and of a random player.
"""

import io
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atlantis_exp.game.preprocessing import Pixels, Preprocessing

FRAMES = 32
"""The frames of a state, the newest last: enough for eight pooled observations that are four frames apart."""


class Archive(NamedTuple):
    """N moments of games, early and late ones of three players."""

    frames: Pixels  # (N, FRAMES, 210, 160) palette indices, the newest last
    players: list[str]
    at: npt.NDArray[np.int64]  # (N,), the newest frame's number in its game
    sha256: str  # of the file


def read_archive(path: Path) -> Archive:
    """Read a game's archive."""
    content = path.read_bytes()
    with np.load(io.BytesIO(content), allow_pickle=False) as stored:
        frames = stored["changes"]
        np.bitwise_xor.accumulate(frames, axis=1, out=frames)
        return Archive(frames, stored["player"].tolist(), stored["frame"], sha256(content).hexdigest())


def rebuild(frames: Pixels, preprocessing: Preprocessing, frameskip: int, stack: int, max_pool: bool) -> Pixels:
    """The state, (stack, size, size), of a player who decides every `frameskip` frames and does so after the last one.

    frames: (F, 210, 160) palette indices, the newest last.

    Raises:
        ValueError: where these are too few.
    """
    if (needed := (stack - 1) * frameskip + 1 + max_pool) > len(frames):
        raise ValueError(f"{stack} observations that are {frameskip} frames apart need {needed} frames")
    observations = []
    for newest in range(len(frames) - 1 - (stack - 1) * frameskip, len(frames), frameskip):
        grey = preprocessing.grey(frames[newest])
        if max_pool:
            grey = np.maximum(preprocessing.grey(frames[newest - 1]), grey)
        observations.append(preprocessing.resize(grey))
    return np.stack(observations)
