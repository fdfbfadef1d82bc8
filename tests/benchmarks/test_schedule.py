"""The order of the ships, against the console, and the bounds, against one game after another."""

from functools import cache
from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt
import pytest
from ale_py import ALEInterface
from ale_py.roms import get_rom_path

from benchmarks import schedule
from benchmarks.pace import BOMBERS_LEFT, SHIPS_LEFT
from benchmarks.schedule import FIRST_TICK, PLAYERS, TICK, Gaps, bombers, most_points

FRAMES = 6_000
TOP_LANE, STATE, BOMBER_EXPLODES = 0x27, 0x53, 0x5B  # bytes of the console's memory, empty at 0 and true above 127
PLAYING = 1  # a wave, neither before it nor after


@cache
def memory_of(seed: int) -> npt.NDArray[np.uint8]:
    """Return the console's memory before and after each frame of a game played at random, (frames + 1, 128)."""
    ale = ALEInterface()
    ale.setFloat("repeat_action_probability", 0.25)
    ale.setInt("random_seed", seed)
    ale.loadROM(cast(Path, get_rom_path("atlantis")))
    ale.reset_game()
    actions, generator = ale.getMinimalActionSet(), np.random.default_rng(seed)
    memory = [ale.getRAM().copy()]
    while len(memory) <= FRAMES and not ale.game_over():
        ale.act(actions[generator.integers(len(actions))])
        memory.append(ale.getRAM().copy())
    return np.array(memory)


@pytest.mark.parametrize("seed", [1, 2])
def test_the_ships_come_at_ticks_and_as_the_register_says_in_every_game(seed: int) -> None:
    memory = memory_of(seed).astype(int)
    (frames,) = np.nonzero(np.diff(memory[:, SHIPS_LEFT]) == -1)
    assert len(frames) > 30
    assert np.all(frames % TICK == FIRST_TICK)
    assert np.diff(frames).min() >= 2 * TICK
    came = np.diff(memory[:, BOMBERS_LEFT])[frames] == -1
    assert came.any()
    assert came.tolist() == ((memory[frames, BOMBERS_LEFT] > 0) & bombers(FRAMES)[frames // TICK]).tolist()


@pytest.mark.parametrize("seed", [1, 2])
def test_a_ship_comes_at_each_tick_of_a_wave_with_an_empty_top_lane_and_no_exploding_bomber(seed: int) -> None:
    memory = memory_of(seed).astype(int)
    ticks = np.arange(FIRST_TICK, len(memory) - 1, TICK)
    before, after = memory[ticks], memory[ticks + 1]
    in_wave = (before[:, STATE] == PLAYING) & (before[:, SHIPS_LEFT] > 0)
    came, exploding = after[:, SHIPS_LEFT] < before[:, SHIPS_LEFT], after[:, BOMBER_EXPLODES] > 127
    assert (in_wave & exploding).any()
    assert not (came & exploding).any()
    assert came[in_wave & ~exploding & (before[:, TOP_LANE] == 0)].all()


def played(draws: list[bool], gaps: Gaps) -> float:
    """Return the most points, by trying each gap after each ship."""

    @cache
    def after(tick: int, wave: int, ships: int, bombers_left: int) -> float:
        if tick >= len(draws):
            return 0
        bomber = draws[tick] and bombers_left > 0
        points, left = (2_000, bombers_left - 1) if bomber else (200, bombers_left)
        if ships == 1:
            return points + 3_500 + after(tick + 8, wave + 1, 10 + 2 * (wave + 1), wave + 1)
        return points + max(after(tick + gap, wave, ships - 1, left) for gap in gaps[bomber])

    return after(0, 0, 10, 0)


@pytest.mark.parametrize("gaps", PLAYERS.values(), ids=PLAYERS)
def test_the_most_points_are_those_of_the_best_of_all_games(gaps: Gaps) -> None:
    draws = bombers(12_000)
    assert most_points(draws, gaps) == played(draws.tolist(), gaps) > 0


def test_a_player_who_foresees_a_bomber_waits_for_it() -> None:
    draws = np.zeros(40, bool)
    draws[31] = True  # the second wave, which has one bomber, begins at tick 26, and every other tick misses it
    misses = most_points(draws, {False: [2], True: [2]})
    assert most_points(draws, {False: [2, 3], True: [2]}) == misses + 1_800


def test_the_bounds_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    schedule.main(["--frames", "20000"])
    assert "foresight" in capsys.readouterr().out
