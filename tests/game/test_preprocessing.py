import hashlib
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from ale_py import ALEInterface
from ale_py.roms import get_rom_path
from hypothesis import given, settings
from hypothesis import strategies as st

from atlantis_exp.game.preprocessing import FrameStack, Preprocessing

Pixels = npt.NDArray[np.uint8]

WHOLE_SCREEN = (0, 160, 210, 0)
FLYING_AREA = (14, 160, 94, 0)
ODD_CUT = (17, 151, 93, 6)


def atlantis() -> ALEInterface:
    ale = ALEInterface()
    ale.setInt("random_seed", 7)
    path = get_rom_path("atlantis")
    assert path is not None
    ale.loadROM(path)
    return ale


@pytest.fixture(scope="module")
def played_screens() -> list[tuple[Pixels, Pixels]]:
    """Grey and RGB of 30 frames, 25 apart, of a random game."""
    ale = atlantis()
    rng = np.random.default_rng(0)
    screens = []
    for frame in range(750):
        ale.act(int(rng.integers(4)))
        if frame % 25 == 24:
            screens.append((ale.getScreenGrayscale(), ale.getScreenRGB()))
    return screens


def preprocess_frame(screen: Pixels, exclude: tuple[int, int, int, int], output: int) -> npt.NDArray[np.float32]:
    """Report figure 2.3, as written there."""
    screen = cv2.cvtColor(screen, cv2.COLOR_RGB2GRAY)  # type: ignore[assignment]
    screen = screen[exclude[0] : exclude[2], exclude[3] : exclude[1]]
    normalized = np.ascontiguousarray(screen, dtype=np.float32) / 255
    return cv2.resize(normalized, (output, output), interpolation=cv2.INTER_AREA)  # type: ignore[return-value]


def digest(arrays: list[Pixels]) -> str:
    return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()[:16]


@pytest.mark.parametrize("crop", [WHOLE_SCREEN, FLYING_AREA, ODD_CUT])
@pytest.mark.parametrize("size", [84, 159])
def test_an_observation_is_within_one_grey_level_of_the_reports(
    played_screens: list[tuple[Pixels, Pixels]], size: int, crop: tuple[int, int, int, int]
) -> None:
    preprocessing = Preprocessing(size, crop)
    for screen, rgb in played_screens:
        observation = preprocessing(screen)
        assert observation.shape == (size, size)
        assert observation.dtype == np.uint8
        report = np.round(255 * preprocess_frame(rgb, crop, size))
        assert np.abs(observation - report).max() <= 1


@pytest.mark.parametrize(
    ("size", "crop", "golden"),
    [
        (84, WHOLE_SCREEN, "6f87915380a958b6"),
        (84, FLYING_AREA, "8222747912cf16c3"),
        (159, WHOLE_SCREEN, "6cb60ea3b0ed4134"),
        (159, FLYING_AREA, "48d8d8cf18193656"),
    ],
)
def test_observations_of_a_known_game_stay_what_they_are(
    played_screens: list[tuple[Pixels, Pixels]], size: int, crop: tuple[int, int, int, int], golden: str
) -> None:
    screens = [screen for screen, _ in played_screens]
    assert digest(screens) == "99ca60023ad23f64", "the game itself has changed"
    assert digest([Preprocessing(size, crop)(screen) for screen in screens]) == golden


@given(data=st.data())
def test_a_crop_counts_up_right_down_left_from_the_top_left(data: st.DataObject) -> None:
    up, left = data.draw(st.integers(0, 209)), data.draw(st.integers(0, 159))
    down, right = data.draw(st.integers(up + 1, 210)), data.draw(st.integers(left + 1, 160))
    screen = np.random.default_rng(0).integers(0, 256, (210, 160), np.uint8)
    cut = Preprocessing(84, (up, right, down, left)).cut(screen)
    np.testing.assert_array_equal(cut, screen[up:down, left:right])
    assert not np.shares_memory(cut, screen)  # the emulator draws the next one in its place


def frames(*values: int) -> Pixels:
    return np.stack([np.full((2, 2), value, np.uint8) for value in values])


def test_an_episodes_first_observation_fills_its_state() -> None:
    stack = FrameStack(num_envs=3, size=2)
    stack.reset([0, 1, 2], frames(1, 2, 3))
    stack.push(frames(4, 5, 6))
    state = stack.reset([2, 0], frames(7, 8))
    assert state[:, :, 0, 0].tolist() == [[8, 8, 8, 8], [2, 2, 2, 5], [7, 7, 7, 7]]


def test_a_state_never_shares_memory_with_the_next() -> None:
    stack = FrameStack(num_envs=1, size=2)
    state = stack.reset([0], frames(1))
    next_state = stack.push(frames(2))
    assert not np.shares_memory(state, next_state)
    assert state[0, :, 0, 0].tolist() == [1, 1, 1, 1]
    assert next_state[0, :, 0, 0].tolist() == [1, 1, 1, 2]


operations = st.lists(
    st.tuples(st.sampled_from(["reset", "push", "push some", "restore"]), st.permutations(range(3)), st.integers(1, 3)),
    max_size=20,
)


@settings(max_examples=60)
@given(operations=operations, lags=st.sets(st.integers(1, 6), max_size=3).map(lambda lags: (0, *sorted(lags))))
def test_a_frame_stack_equals_lists_of_whole_histories(
    operations: list[tuple[str, list[int], int]], lags: tuple[int, ...]
) -> None:
    stack = FrameStack(3, 2, lags, units=1)
    histories, memory = [[0] * 7 for _ in range(3)], np.zeros((3, 1))
    handed_out = []
    for value, (operation, order, count) in enumerate(operations, start=1):
        envs = tuple(order[:count])
        if operation == "reset":
            stack.reset(envs, frames(*(10 * value + env for env in envs)))
            for env in envs:
                histories[env], memory[env] = [10 * value + env] * 7, 0
        elif operation == "restore":
            restored, kept = FrameStack(3, 2, lags, units=1), stack.state_dict()
            stack.memory[:] = -1
            restored.load_state_dict(kept)
            stack = restored
        else:
            envs = (0, 1, 2) if operation == "push" else envs
            observations = frames(*(10 * value + env for env in envs))
            stack.push(observations, None if operation == "push" else envs)
            observations[:] = 255
            for env in envs:
                histories[env].append(10 * value + env)
        np.testing.assert_array_equal(stack.memory, memory)
        stack.memory[:] = memory[:] = value
        handed_out.append((stack.state, [[history[-1 - lag] for lag in reversed(lags)] for history in histories]))
    for state, expected in handed_out:
        assert state[:, :, 0, 0].tolist() == expected
        assert state[:, :, 1, 1].tolist() == expected


@pytest.mark.parametrize(
    "memory", [np.zeros((3, 2), np.float32), np.zeros((3, 1)), np.full((3, 1), np.nan, np.float32)]
)
def test_a_memory_of_another_size_or_type_or_of_no_numbers_is_refused(memory: npt.NDArray[Any]) -> None:
    state = FrameStack(3, 2, units=1).state_dict()
    with pytest.raises(ValueError, match="the player's memory"):
        FrameStack(3, 2, units=1).load_state_dict({**state, "memory": memory})
