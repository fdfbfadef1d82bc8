"""Play one game on ALE, as Gymnasium plays it for the same seed and actions; save and restore it exactly."""

from pathlib import Path
from typing import Any, NamedTuple, cast

import gymnasium
import numpy as np
from ale_py import ALEInterface, ALEState, LoggerMode
from ale_py.roms import get_all_rom_ids, get_rom_path

from atlantis_exp.faults import ConfigError
from atlantis_exp.game.preprocessing import Pixels, Preprocessing
from atlantis_exp.games import SCREEN, Game

ALEInterface.setLoggerMode(LoggerMode.Error)  # of the whole process, and before the first emulator prints its banner


class Step(NamedTuple):
    """The result of one step of the agent."""

    observation: Pixels  # (size, size)
    reward: float  # the game's own, never clipped
    terminated: bool
    truncated: bool
    life_lost: bool
    frames: int  # emulated in this step
    points: list[float]  # the reward by source, in the order of the game's sources


def check_game(game: Game) -> None:
    """Raise ConfigError if ALE lacks the game's ROM, or has another screen or other actions for it."""
    if game.rom not in get_all_rom_ids():
        raise ConfigError(f"{game.rom}: ALE has no ROM of that name")
    ale = ALEInterface()
    ale.loadROM(cast(Path, get_rom_path(game.rom)))
    if (screen := ale.getScreenDims()) != SCREEN:
        raise ConfigError(f"{game.rom}: its screen is {screen} pixels; only {SCREEN} can be played")
    if (actions := tuple(action.name for action in ale.getMinimalActionSet())) != game.actions:
        raise ConfigError(f"{game.rom}: actions = {game.actions}: should be ALE's, {actions}")


class Emulator:
    """One game, from frames to observations; until it gets a seed it uses 0.

    game: its ROM, its actions (an action is an index into them), and the sources of its points.
    frameskip: frames in a step, or (low, high): drawn from low to high - 1 in every step, as in the report.
    sticky: probability that a frame repeats the previous frame's action (Machado et al., 2018).
    max_frames: frames after which an episode is truncated.
    max_steps: steps after which an episode is truncated (27,000 in report figure 1.3), or None.
    noop_max: an episode begins with 1 to `noop_max` frames of NOOP; 0 for none.
    max_pool: take each pixel's maximum over a step's last two frames (Mnih et al., 2015), and end a step with its
        episode, as Gymnasium's `AtariPreprocessing` does. Raises ValueError if a step may be one frame.
    """

    def __init__(
        self,
        *,
        game: Game,
        preprocessing: Preprocessing,
        frameskip: int | tuple[int, int],
        sticky: float,
        max_frames: int,
        max_steps: int | None,
        noop_max: int,
        max_pool: bool,
    ) -> None:
        self.game, self.preprocessing = game, preprocessing
        self._frameskip = frameskip
        self._max_steps = max_steps
        self._noop_max = noop_max
        self._max_pool = max_pool
        if max_pool and (frameskip if isinstance(frameskip, int) else frameskip[0]) < 2:
            raise ValueError(f"max_pool needs two frames in every step, frameskip is {frameskip}")

        self._ale = ALEInterface()
        self._ale.setFloat("repeat_action_probability", sticky)
        self._ale.setInt("max_num_frames_per_episode", max_frames)
        self._is_loaded = False  # loading takes as long as a thousand frames, and each seed needs it
        self._steps = 0
        self._screen: Pixels = np.zeros(SCREEN, np.uint8)  # grey
        self._pool = preprocessing.cut(self._screen)  # of the last step, cropped; max_pool only

    @property
    def lives(self) -> int:
        """Lives as ALE counts them; in some games the count can rise."""
        return self._ale.lives()

    def screen_rgb(self) -> Pixels:
        """Return the frame on screen in colour, (210, 160, 3) uint8."""
        return self._ale.getScreenRGB()

    def reset(self, seed: int | None = None) -> Pixels:
        """Begin an episode and return its first observation; without a seed the random streams continue."""
        if seed is not None or not self._is_loaded:
            self._load_game(seed or 0)
        self._keep_origin()
        self._begun = True
        self._ale.reset_game()
        if self._noop_max:
            for _ in range(self._generator.integers(1, self._noop_max + 1)):
                self._ale.act(self._actions[0])
        self._steps = 0
        self._lives = self.lives
        self._ale.getScreenGrayscale(self._screen)
        self._pool = self.preprocessing.cut(self._screen)
        return self.preprocessing.resize(self._pool)

    def step(self, action: int) -> Step:
        """Play an action for one frameskip; termination takes precedence over truncation."""
        self._played.append(action)
        frameskip = self._frameskip
        if not isinstance(frameskip, int):
            frameskip = int(self._generator.integers(*frameskip))
        frames_before, lives_before = self._ale.getFrameNumber(), self._lives
        self._points = [0.0] * len(self.game.sources)
        if self._max_pool:
            reward = self._act_and_pool(action, frameskip)
        else:
            # Past the episode's end ALE emulates nothing, but still draws for the sticky actions.
            reward = sum(self._act(action) for _ in range(frameskip))
        self._ale.getScreenGrayscale(self._screen)
        observation = self.preprocessing.resize(self._pool) if self._max_pool else self.preprocessing(self._screen)
        self._steps += 1
        terminated = self._ale.game_over(with_truncation=False)
        truncated = not terminated and (self._ale.game_truncated() or self._steps == self._max_steps)
        self._lives = self.lives
        return Step(
            observation,
            float(reward),
            terminated,
            truncated,
            self._lives < lives_before,
            self._ale.getFrameNumber() - frames_before,
            self._points,
        )

    def state_dict(self) -> dict[str, Any]:
        """Return the state before the episode and the episode's actions.

        ALE's own state is not exact in another emulator: its TIA loses the positions of the graphics registers.
        """
        return {
            "ale": self._origin,
            "generator": self._generator_origin,
            "begun": self._begun,
            "actions": np.frombuffer(bytes(self._played), np.uint8),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Replay the episode so far, some 4,000 steps a second. Raises: ValueError, IndexError."""
        if len(state["actions"]) > self._ale.getInt("max_num_frames_per_episode"):
            raise ValueError("its episode has more actions than frames allowed")
        if not self._is_loaded:
            self._load_game(0)
        try:
            self._ale.restoreState(ALEState(state["ale"].tobytes()))
        except SystemError:  # from C++, without a reason
            raise ValueError("ALE cannot restore its state") from None
        self._generator.bit_generator.state = state["generator"]
        self._keep_origin()
        if state["begun"]:
            self.reset()
        for action in state["actions"].tolist():
            self.step(action)

    def _load_game(self, seed: int) -> None:
        """Seed both random streams, as ale_py.env.AtariEnv.seed_game does; ALE takes a seed only with a game."""
        own_seed, ale_seed = np.random.SeedSequence(seed).generate_state(2)
        self._generator = np.random.default_rng(own_seed)
        self._ale.setInt("random_seed", ale_seed.astype(np.int32))
        self._ale.loadROM(cast(Path, get_rom_path(self.game.rom)))
        self._actions = self._ale.getMinimalActionSet()
        self._is_loaded = True
        self._keep_origin()

    def _keep_origin(self) -> None:
        self._origin = np.frombuffer(self._ale.cloneState(include_rng=True).serialize(), np.uint8)
        self._generator_origin = self._generator.bit_generator.state
        self._begun = False
        self._played = bytearray()  # actions since the origin

    def _act(self, action: int) -> int:
        """Play one frame and return its reward; add it to the step's points by source."""
        reward = self._ale.act(self._actions[action])
        if reward and self.game.points is not None:
            for source, points in enumerate(self.game.points(reward, self._ale.getRAM())):
                self._points[source] += points
        return reward

    def _act_and_pool(self, action: int, frameskip: int) -> int:
        """Return the reward; an interrupted step pools with the previous one, as in `AtariPreprocessing`."""
        reward = 0
        before_last = last = self._pool
        for left in reversed(range(frameskip)):
            reward += self._act(action)
            if self._ale.game_over():
                break
            if left <= 1:
                self._ale.getScreenGrayscale(self._screen)
                before_last, last = last, self.preprocessing.cut(self._screen)
        self._pool = np.maximum(before_last, last)
        return reward


def query_environment(name: str) -> dict[str, object]:
    """Return Gymnasium's facts of an Atari environment (report figures 1.1 to 1.3), with its cap on frames.

    The reward range is gym's default: Atari never narrowed it, and Gymnasium 1.0 dropped the attribute.
    """
    spec = gymnasium.spec(name)
    env = gymnasium.make(name)
    answers = {
        "action_space": str(env.action_space),
        "possible_actions": env.get_wrapper_attr("get_action_meanings")(),
        "observation_space": str(env.observation_space),
        "max_episode_steps": spec.max_episode_steps,
        "max_episode_frames": spec.kwargs["max_num_frames_per_episode"],
        "nondeterministic": spec.nondeterministic,
        "reward_range": (-np.inf, np.inf),
        "reward_threshold": spec.reward_threshold,
    }
    env.close()
    return answers
