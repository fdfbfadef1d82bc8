import json
import subprocess
import sys
from collections.abc import Callable, Sequence, Set
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import pytest
from ale_py import ALEInterface
from ale_py.roms import get_rom_path
from gymnasium.wrappers import AtariPreprocessing, FrameStackObservation

from atlantis_exp.build import build_game
from atlantis_exp.components import known
from atlantis_exp.game.emulator import Emulator, Step, query_environment
from atlantis_exp.game.preprocessing import FrameStack, Preprocessing

Pixels = npt.NDArray[np.uint8]

ATLANTIS = build_game(known("env")["atlantis"])

pytestmark = pytest.mark.filterwarnings("ignore:.*out of date:DeprecationWarning")


def emulator(**changes: Any) -> Emulator:
    settings: dict[str, Any] = {
        "game": ATLANTIS,
        "preprocessing": Preprocessing(84, (0, 160, 210, 0)),
        "frameskip": 4,
        "sticky": 0.25,
        "max_frames": 108_000,
        "max_steps": None,
        "noop_max": 0,
        "max_pool": False,
    }
    return Emulator(**settings | changes)


def lazy_player(seed: int) -> Callable[[], int]:
    """Fires so rarely that an episode is over after some 600 steps."""
    rng = np.random.default_rng(seed)
    return lambda: int(rng.choice(4, p=[0.85, 0.05, 0.05, 0.05]))


def play_beside_gymnasium(
    ours: Emulator,
    env: "gymnasium.Env[Pixels, int]",
    seed: int,
    first_view: Callable[[Pixels], Pixels],
    view: Callable[[Pixels], Pixels],
) -> list[Step]:
    """Asserts that a seeded episode and the one after it are equal, and returns the last step of each."""
    act = lazy_player(seed)
    ends = []
    for episode_seed in (seed, None):
        theirs, info = env.reset(seed=episode_seed)
        np.testing.assert_array_equal(first_view(ours.reset(episode_seed)), theirs)
        lives = info["lives"]
        ended = False
        while not ended:
            action, frames_before = act(), info["frame_number"]
            step = ours.step(action)
            theirs, reward, terminated, truncated, info = env.step(action)
            frames = info["frame_number"] - frames_before
            assert step[1:6] == (reward, terminated, truncated, info["lives"] < lives, frames)
            assert ours.lives == info["lives"]
            lives = info["lives"]
            assert np.array_equal(view(step.observation), theirs)
            ended = terminated or truncated
        assert np.array_equal(ours.screen_rgb(), env.get_wrapper_attr("ale").getScreenRGB())
        ends.append(step)
    env.close()
    return ends


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2**31 + 5])
@pytest.mark.parametrize(("name", "frameskip"), [("Atlantis-v0", (2, 5)), ("ALE/Atlantis-v5", 4)])
def test_it_plays_as_gymnasium_does(name: str, frameskip: int | tuple[int, int], seed: int) -> None:
    ours = emulator(frameskip=frameskip)
    env = gymnasium.make(name, disable_env_checker=True)
    ends = play_beside_gymnasium(ours, env, seed, lambda _: ours.screen_rgb(), lambda _: ours.screen_rgb())
    assert all(end.terminated for end in ends)


def test_it_truncates_as_gymnasium_does() -> None:
    ours = emulator(frameskip=(2, 5), max_frames=401)
    env = gymnasium.make("Atlantis-v0", max_num_frames_per_episode=401, disable_env_checker=True)
    ends = play_beside_gymnasium(ours, env, 3, lambda _: ours.screen_rgb(), lambda _: ours.screen_rgb())
    assert all(end.truncated and not end.terminated for end in ends)


def play_beside_atari_preprocessing(seed: int, noop_max: int, max_frames: int) -> list[Step]:
    env = gymnasium.make(
        "ALE/Atlantis-v5", frameskip=1, max_num_frames_per_episode=max_frames, disable_env_checker=True
    )
    env = AtariPreprocessing(env, noop_max=noop_max, frame_skip=4, screen_size=84, terminal_on_life_loss=False)
    stack = FrameStack(num_envs=1, size=84)
    return play_beside_gymnasium(
        emulator(noop_max=noop_max, max_pool=True, max_frames=max_frames),
        FrameStackObservation(env, 4),
        seed,
        lambda observation: stack.reset([0], observation[np.newaxis])[0],
        lambda observation: stack.push(observation[np.newaxis])[0],
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("noop_max", [30, 0])
def test_pooled_stacked_states_are_those_of_atari_preprocessing(seed: int, noop_max: int) -> None:
    ends = play_beside_atari_preprocessing(seed, noop_max, max_frames=108_000)
    assert all(end.terminated for end in ends)


@pytest.mark.parametrize(
    "max_frames", [401, *(pytest.param(frames, marks=pytest.mark.slow) for frames in (400, 402, 403))]
)
def test_frames_left_in_the_pool_by_an_unfinished_step_are_those_of_atari_preprocessing(max_frames: int) -> None:
    ends = play_beside_atari_preprocessing(seed=3, noop_max=0, max_frames=max_frames)
    assert all(end.truncated and end.frames == (max_frames % 4 or 4) for end in ends)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("actions", "never", "seed", "bonuses"),
    [
        ((0,), {"centre_vessel", "side_vessel", "centre_bomber", "side_bomber"}, 0, {500, 1_500}),
        ((0, 1), {"side_vessel", "side_bomber"}, 6, {1_000, 2_000}),  # FIRE alone
        ((0, 2, 3), {"centre_vessel", "centre_bomber"}, 2, {1_000, 2_000}),
    ],
)
def test_no_points_are_of_a_gun_that_never_fires_and_a_bonus_is_500_a_building(
    actions: Sequence[int], never: Set[str], seed: int, bonuses: Set[float]
) -> None:
    """So what two or four buildings pay is told from what a bomber pays, which is the same."""
    ours, rng = emulator(), np.random.default_rng(seed)
    ours.reset(seed)
    totals, paid, step = dict.fromkeys(ATLANTIS.sources, 0.0), set(), None
    while step is None or not step.terminated:
        step = ours.step(int(rng.choice(actions)))
        points = dict(zip(ATLANTIS.sources, step.points, strict=True))
        assert sum(points.values()) == step.reward
        if bonus := points["wave_bonus"]:
            assert bonus == step.reward == 500 * (ours.lives + 1)  # ALE does not count the last building
            paid.add(bonus)
        totals = {source: total + points[source] for source, total in totals.items()}
    assert {source for source, total in totals.items() if not total} == never
    assert paid >= bonuses


def test_two_hits_in_one_frame_are_two() -> None:
    ours, rng = emulator(), np.random.default_rng(47)
    ours.reset(seed=47)
    *_, step = (ours.step(int(rng.integers(4))) for _ in range(821))
    assert step.points == [0, 400, 0, 0, 0]


def test_actions_are_the_minimal_set_of_ale() -> None:
    ale = ALEInterface()
    path = get_rom_path("atlantis")
    assert path is not None
    ale.loadROM(path)
    assert tuple(action.name for action in ale.getMinimalActionSet()) == ATLANTIS.actions


def test_max_steps_truncate_every_episode_anew() -> None:
    ours = emulator(max_steps=5)
    for _ in range(2):
        ours.reset()
        assert [ours.step(0).truncated for _ in range(5)] == [False] * 4 + [True]


def test_an_episode_that_ends_on_its_last_allowed_step_is_terminated() -> None:
    lengths = []
    for max_steps in (None, 423):  # every game without a shot lasts 423 steps
        ours = emulator(max_steps=max_steps)
        ours.reset(seed=0)
        steps = [ours.step(0)]
        while not (steps[-1].terminated or steps[-1].truncated):
            steps.append(ours.step(0))
        assert steps[-1].terminated
        assert not steps[-1].truncated
        lengths.append(len(steps))
    assert lengths == [423, 423]


def test_before_its_first_seed_it_plays_as_if_seeded_with_0() -> None:
    unseeded, seeded = emulator(frameskip=(2, 5)), emulator(frameskip=(2, 5))
    unseeded.reset()
    seeded.reset(seed=0)
    for action in (1, 2, 3) * 20:
        unseeded.step(action)
        seeded.step(action)
    np.testing.assert_array_equal(unseeded.screen_rgb(), seeded.screen_rgb())


def test_a_pool_of_one_frame_is_refused() -> None:
    for frameskip in (1, (1, 5)):
        with pytest.raises(ValueError, match="max_pool needs two frames"):
            emulator(frameskip=frameskip, max_pool=True)


def through_a_file(state: dict[str, Any]) -> dict[str, Any]:
    return {
        key: np.frombuffer(leaf.tobytes(), leaf.dtype).reshape(leaf.shape)
        if isinstance(leaf, np.ndarray)
        else json.loads(json.dumps(leaf))
        for key, leaf in state.items()
    }


@pytest.mark.parametrize(
    "settings",
    [
        pytest.param({"frameskip": (2, 5), "max_steps": 500}, marks=pytest.mark.slow),
        {"frameskip": 4, "max_pool": True, "noop_max": 30, "max_frames": 1_198},
    ],
)
def test_a_restored_emulator_plays_on_as_if_never_stopped(settings: dict[str, Any]) -> None:
    ours, act = emulator(**settings), lazy_player(0)
    ours.reset(seed=5)
    for _ in range(200):
        ours.step(act())
    state = ours.state_dict()
    frozen = through_a_file(state)
    restored = emulator(**settings)
    restored.reset(seed=6)  # any other stream
    restored.load_state_dict(frozen)
    np.testing.assert_array_equal(restored.screen_rgb(), ours.screen_rgb())
    assert restored.lives == ours.lives
    ends = 0
    for _ in range(850):
        action = act()
        theirs, step = restored.step(action), ours.step(action)
        np.testing.assert_array_equal(theirs.observation, step.observation)
        assert theirs[1:] == step[1:]
        assert restored.lives == ours.lives
        if step.terminated or step.truncated:
            ends += 1
            np.testing.assert_array_equal(restored.reset(), ours.reset())
    assert ends >= 2
    np.testing.assert_array_equal(restored.screen_rgb(), ours.screen_rgb())
    for key, leaf in frozen.items():
        np.testing.assert_equal(state[key], leaf)  # playing on has not changed what was saved


@pytest.mark.slow
def test_a_restored_emulator_draws_every_pixel_as_if_never_stopped() -> None:
    """ALE's own state forgets registers of the TIA: shots, which are seldom in the crop, would be drawn elsewhere."""
    rng = np.random.default_rng(0)
    ours = emulator(frameskip=(2, 5))
    ours.reset(seed=0)
    for step in range(60):
        if step == 45:
            ours.reset()
        restored = emulator(frameskip=(2, 5))
        restored.load_state_dict(through_a_file(ours.state_dict()))
        action = int(rng.integers(4))
        assert ours.step(action)[1:] == restored.step(action)[1:]
        np.testing.assert_array_equal(restored.screen_rgb(), ours.screen_rgb())


def test_a_pool_restored_before_an_unfinished_step_is_the_one_saved() -> None:
    ours, restored = emulator(max_pool=True, max_frames=402), emulator(max_pool=True, max_frames=402)
    ours.reset(seed=0)
    for _ in range(100):
        ours.step(0)
    restored.load_state_dict(through_a_file(ours.state_dict()))
    step = ours.step(0)
    assert step.frames == 2
    np.testing.assert_array_equal(restored.step(0).observation, step.observation)


def test_the_game_is_loaded_once_a_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes ALE a fifth of a second."""
    loaded = []

    def path_of(game: str) -> Path | None:
        loaded.append(game)
        return get_rom_path(game)

    monkeypatch.setattr("atlantis_exp.game.emulator.get_rom_path", path_of)
    ours = emulator()
    assert loaded == []
    ours.reset(seed=1)
    ours.reset()
    state = ours.state_dict()
    assert len(loaded) == 1
    unseeded, seeded, restored = emulator(), emulator(), emulator()
    assert (unseeded.reset() == seeded.reset(seed=0)).all()
    restored.load_state_dict(state)
    assert len(loaded) == 4


def test_it_is_silent() -> None:
    code = (
        "from atlantis_exp.components import facts_of, game_of\n"
        "from atlantis_exp.game.emulator import Emulator\n"
        "from atlantis_exp.game.preprocessing import Preprocessing\n"
        "game = Emulator(preprocessing=Preprocessing(84, (0, 160, 210, 0)), frameskip=4, sticky=0.25,\n"
        "                game=facts_of(game_of('Atlantis-v0')),\n"
        "                max_frames=1_000, max_steps=None, noop_max=0, max_pool=False)\n"
        "game.reset(seed=1)\n"
        "game.load_state_dict(game.state_dict())\n"
    )
    told = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
    assert (told.stdout, told.stderr) == (b"", b"")


def test_the_query_answers_report_figure_1_3() -> None:
    assert query_environment("Atlantis-v0") == {
        "action_space": "Discrete(4)",
        "possible_actions": ["NOOP", "FIRE", "RIGHTFIRE", "LEFTFIRE"],
        "observation_space": "Box(0, 255, (210, 160, 3), uint8)",
        "max_episode_steps": None,  # 27,000 in the report; ALE 0.12 counts frames
        "max_episode_frames": 108_000,
        "nondeterministic": False,
        "reward_range": (-np.inf, np.inf),
        "reward_threshold": None,
    }
