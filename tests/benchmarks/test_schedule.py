"""The order of the ships, against the console, and the bounds, against one game after another."""

from functools import cache
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from ale_py import ALEInterface
from ale_py.roms import get_rom_path

from benchmarks import schedule
from benchmarks.pace import BOMBERS_LEFT, SHIPS_LEFT
from benchmarks.schedule import FIRST_TICK, PLAYERS, TICK, Gaps, bombers, most_points


def ships_of(seed: int, frames: int) -> list[tuple[int, bool, bool]]:
    """Return when each ship comes in a game played at random, whether a bomber may, and whether it is one."""
    ale = ALEInterface()
    ale.setFloat("repeat_action_probability", 0.25)
    ale.setInt("random_seed", seed)
    ale.loadROM(cast(Path, get_rom_path("atlantis")))
    ale.reset_game()
    actions, generator = ale.getMinimalActionSet(), np.random.default_rng(seed)
    ships, before = [], ale.getRAM().copy()
    for frame in range(frames):
        ale.act(actions[generator.integers(len(actions))])
        if ale.game_over():
            break
        now = ale.getRAM().copy()
        if int(before[SHIPS_LEFT]) - int(now[SHIPS_LEFT]) == 1:
            ships.append((frame, bool(before[BOMBERS_LEFT]), bool(now[BOMBERS_LEFT] < before[BOMBERS_LEFT])))
        before = now
    return ships


@pytest.mark.parametrize("seed", [1, 2])
def test_the_ships_come_at_ticks_and_as_the_register_says_in_every_game(seed: int) -> None:
    ships = ships_of(seed, 6_000)
    draws = bombers(6_000)
    frames = [frame for frame, _, _ in ships]
    assert len(ships) > 30
    assert all(frame % TICK == FIRST_TICK for frame in frames)
    assert np.diff(frames).min() >= 2 * TICK
    assert [bomber for _, _, bomber in ships] == [may and bool(draws[frame // TICK]) for frame, may, _ in ships]
    assert any(bomber for _, _, bomber in ships)


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
