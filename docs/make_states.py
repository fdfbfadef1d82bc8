"""Make `atlantis_exp/game/atlantis_states.npz`, the archived game states that `compare why=true` asks networks about.

`python docs/make_states.py`, from the root of the checkout: minutes on one core. The same machine makes the same
bytes; elsewhere a rounding may lead to other games, so the file in the repository is the archive, and its SHA-256 is in
a test.
"""

from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atlantis_exp.components import facts_of, game_of
from atlantis_exp.game.archive import FRAMES
from atlantis_exp.game.emulator import Emulator
from atlantis_exp.game.preprocessing import FrameStack, Preprocessing
from atlantis_exp.sessions.cards import build_exported_actor, read_card
from atlantis_exp.training.actor import Actor, RandomActor

GAME = facts_of(game_of("Atlantis-v0"))
STATES = Path("atlantis_exp/game/atlantis_states.npz")
MOST_FRAMES = 30_000  # of a game, more than eight minutes
EPSILON = 0.05
FRAMESKIP = (2, 5)  # frames a decision, drawn as in Atlantis-v0

Pixels = npt.NDArray[np.uint8]


class Player(NamedTuple):
    """Who plays, what it sees, and how many moments of how many games enter the archive."""

    name: str
    actor: Actor
    preprocessing: Preprocessing
    stack: int
    games: int
    moments: int  # a game


def main() -> None:
    """Play the games, and keep evenly spaced moments of each."""
    players = [
        network("cnn_fast", games=3, moments=16),
        network("resnet_fast", games=3, moments=16),
        Player("random", RandomActor(len(GAME.actions)), Preprocessing(8, (0, 160, 210, 0)), 1, games=8, moments=4),
    ]
    states: list[Pixels] = []
    origins: list[tuple[str, int, int]] = []
    for player in players:
        for seed in range(player.games):
            actions = play(player, seed)
            # Not before the first FRAMES frames, and none of the last.
            at = np.linspace(FRAMES, len(actions), 2 * player.moments + 1).astype(int)[1::2].tolist()
            states.extend(seen(seed, actions, at))
            origins.extend((player.name, seed, frame) for frame in at)
            print(f"{player.name}, game {seed}: {len(actions):,} frames", flush=True)
    frames = np.stack(states)
    changes = frames.copy()
    changes[:, 1:] ^= frames[:, :-1]  # which compress far better than frames
    names, seeds, at_frames = zip(*origins, strict=True)
    np.savez_compressed(STATES, changes=changes, player=names, seed=seeds, frame=at_frames)
    print(f"{STATES}: {len(states)} states, {STATES.stat().st_size:,} bytes")


def network(name: str, games: int, moments: int) -> Player:
    """A player of the weights in `pretrained/`."""
    card, weights = read_card(Path("pretrained") / name)
    env = card.config.env
    actor = build_exported_actor(card.config, weights, "cpu")
    return Player(name, actor, Preprocessing(env.size, env.crop), env.stack, games, moments)


def emulator(preprocessing: Preprocessing) -> Emulator:
    """One whose step is one frame, so that every frame is seen."""
    return Emulator(
        game=GAME,
        preprocessing=preprocessing,
        frameskip=1,
        sticky=0.25,
        max_frames=MOST_FRAMES,
        max_steps=None,
        noop_max=0,
        max_pool=False,
    )


def play(player: Player, seed: int) -> list[int]:
    """A game's actions, one a frame."""
    game = emulator(player.preprocessing)
    generator = np.random.default_rng(seed)
    stacks = FrameStack(1, player.preprocessing.size, player.stack)
    stacks.reset([0], game.reset(seed)[np.newaxis])
    actions: list[int] = []
    while True:
        action = int(player.actor.act(stacks.state, EPSILON, [generator]).actions[0])
        for _ in range(generator.integers(*FRAMESKIP)):
            step = game.step(action)
            actions.append(action)
            if step.terminated or step.truncated:
                return actions
        stacks.push(step.observation[np.newaxis])


def seen(seed: int, actions: list[int], at: list[int]) -> Iterator[Pixels]:
    """The last frames before each of these frames of a game, (FRAMES, 210, 160) palette indices."""
    game = emulator(Preprocessing(8, (0, 160, 210, 0)))
    game.reset(seed)
    recent = deque([game.screen], maxlen=FRAMES)
    for frame, action in enumerate(actions, 1):
        game.step(action)
        recent.append(game.screen)
        if frame in at:
            yield np.stack(recent)


if __name__ == "__main__":
    main()
