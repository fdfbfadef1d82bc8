"""The archived states: what they are, and that a state of theirs is the one that the emulator would have shown."""

import hashlib
from pathlib import Path

import numpy as np
import pytest

from atlantis_exp.components import facts_of, game_of
from atlantis_exp.game import archive
from atlantis_exp.game.archive import FRAMES, read_archive, rebuild
from atlantis_exp.game.emulator import Emulator
from atlantis_exp.game.preprocessing import PALETTE, FrameStack, Preprocessing

GAME = facts_of(game_of("Atlantis-v0"))
STATES = Path(archive.__file__).with_name("atlantis_states.npz")
SHA256 = "e94febf5cb2efab959fd5658e101ab752fd0b33cae2649494ba6ed3c73148a04"


def test_the_archive_is_the_one_that_ships_and_small() -> None:
    content = STATES.read_bytes()
    assert hashlib.sha256(content).hexdigest() == SHA256 == read_archive(STATES).sha256
    assert len(content) < 1_500_000


def test_it_has_early_and_late_moments_of_three_players_and_no_two_alike() -> None:
    states = read_archive(STATES)
    assert states.frames.shape == (128, FRAMES, 210, 160)
    assert {name: states.players.count(name) for name in states.players} == {
        "cnn_fast": 48,
        "resnet_fast": 48,
        "random": 32,
    }
    assert states.at.min() < 1_000
    assert states.at.max() > 25_000
    assert len({state[-1].tobytes() for state in states.frames}) == 128
    assert set(np.unique(states.frames)) <= set(range(0, 256, 2))  # colours


@pytest.mark.parametrize(
    ("frameskip", "stack", "size", "crop", "max_pool"),
    [
        (4, 4, 84, (0, 160, 210, 0), True),
        (4, 8, 40, (16, 160, 96, 0), True),
        (3, 4, 159, (16, 160, 96, 0), False),
        (2, 1, 84, (17, 151, 93, 6), True),
        (1, 3, 84, (16, 160, 136, 0), False),
    ],
)
@pytest.mark.thinned(5)
def test_a_state_rebuilt_of_frames_is_the_emulators_bit_for_bit(
    frameskip: int, stack: int, size: int, crop: tuple[int, int, int, int], max_pool: bool
) -> None:
    """Two emulators play the same game, one in steps and one frame by frame."""
    preprocessing = Preprocessing(size, crop)
    settings = {"sticky": 0.25, "max_frames": 10_000, "max_steps": None, "noop_max": 0}
    player = Emulator(game=GAME, preprocessing=preprocessing, frameskip=frameskip, max_pool=max_pool, **settings)  # type: ignore[arg-type]
    watcher = Emulator(game=GAME, preprocessing=preprocessing, frameskip=1, max_pool=False, **settings)  # type: ignore[arg-type]
    stacks = FrameStack(1, size, stack)
    stacks.reset([0], player.reset(7)[np.newaxis])
    watcher.reset(7)
    frames = [watcher.screen]
    generator = np.random.default_rng(7)
    compared = 0
    for _ in range(400 // frameskip):
        action = int(generator.integers(4))
        stacks.push(player.step(action).observation[np.newaxis])
        for _ in range(frameskip):
            watcher.step(action)
            frames.append(watcher.screen)
        if len(frames) > FRAMES:
            seen = np.stack(frames[-FRAMES:])
            np.testing.assert_array_equal(rebuild(seen, preprocessing, frameskip, stack, max_pool), stacks.state[0])
            compared += 1
    assert compared > 90
    assert (PALETTE[watcher.screen] == player.screen_rgb()).all()


def test_a_state_that_needs_more_frames_is_refused() -> None:
    frames = read_archive(STATES).frames[0]
    with pytest.raises(ValueError, match="8 observations that are 5 frames apart need 37 frames"):
        rebuild(frames, Preprocessing(84, (0, 160, 210, 0)), 5, 8, True)
