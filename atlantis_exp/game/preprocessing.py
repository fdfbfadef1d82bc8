"""Turn screens of the Atari 2600 into observations, and observations into states."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import cv2
import numpy as np
import numpy.typing as npt

Pixels = npt.NDArray[np.uint8]
Envs = Sequence[int] | npt.NDArray[np.intp]


@dataclass(frozen=True)
class Preprocessing:
    """Turn a screen in ALE's grey, (210, 160) uint8, into an observation, (size, size) uint8.

    Crop, area interpolation: within one grey level of 255 times the float of report figure 2.3. `crop` is its
    `exclude`, (UP, RIGHT, DOWN, LEFT) in pixels, and keeps rows UP to DOWN - 1 and columns LEFT to RIGHT - 1.
    """

    size: int
    crop: tuple[int, int, int, int]

    def __call__(self, screen: Pixels) -> Pixels:
        return self.resize(self.cut(screen))

    def cut(self, screen: Pixels) -> Pixels:
        """Return a copy of the crop of a screen, (DOWN - UP, RIGHT - LEFT) uint8."""
        up, right, down, left = self.crop
        return screen[up:down, left:right].copy()

    def resize(self, cut: Pixels) -> Pixels:
        """Return a crop at the observation's size, (size, size) uint8."""
        return cast(Pixels, cv2.resize(cut, (self.size, self.size), interpolation=cv2.INTER_AREA))


class FrameStack:
    """Observations of `lags` steps ago in each environment, oldest first; an episode's first one fills missing places.

    `state` is (num_envs, stack, size, size) uint8. Every change makes a new array, so earlier states never change:
    `stack_frame` of report figure 2.3 shifts in place, which makes every next state equal to its state.

    `memory`, (num_envs, units) float32, belongs to the player, who writes to it; it is zero when an episode begins.
    """

    def __init__(self, num_envs: int, size: int, lags: Sequence[int] = range(4), units: int = 0) -> None:
        self._lags = np.array(lags)[::-1]
        self._ring: Pixels = np.zeros((num_envs, lags[-1] + 1, size, size), np.uint8)  # each environment's newest
        self._newest = np.zeros(num_envs, np.intp)  # each environment's place in it
        self._all = np.arange(num_envs)
        self.state = self._ago(self._all, self._lags)
        self.memory = np.zeros((num_envs, units), np.float32)

    def reset(self, envs: Envs, observations: Pixels) -> Pixels:
        """Begin an episode in `envs` with these observations, (len(envs), size, size); return the state of all."""
        rows = np.asarray(envs, np.intp)
        self._ring[rows] = observations[:, np.newaxis]
        self.memory[rows] = 0.0
        return self._renew(rows)

    def push(self, observations: Pixels, envs: Envs | None = None) -> Pixels:
        """Append these observations, (len(envs), size, size), in `envs`, by default all; return the state of all."""
        rows = self._all if envs is None else np.asarray(envs, np.intp)
        newest = self._newest[rows] = (self._newest[rows] + 1) % self._ring.shape[1]
        self._ring[rows, newest] = observations
        return self._renew(rows)

    def state_dict(self) -> dict[str, Any]:
        state = self._ago(self._all, np.arange(self._ring.shape[1])[::-1])
        return {"state": state, **({"memory": self.memory.copy()} if self.memory.size else {})}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        if (state["state"].shape, state["state"].dtype) != (self._ring.shape, np.uint8):
            raise ValueError("the stacks do not have this game's shape")
        memory = state["memory"] if self.memory.size else self.memory
        if (memory.shape, memory.dtype) != (self.memory.shape, np.float32) or not np.isfinite(memory).all():
            raise ValueError("the player's memory is not of its size, or not finite")
        self._ring, self._newest[:] = state["state"].copy(), self._ring.shape[1] - 1
        self.memory[:] = memory
        self._renew(self._all)

    def _renew(self, rows: npt.NDArray[np.intp]) -> Pixels:
        """Make the states of some environments anew; return the state of all."""
        states = self._ago(rows, self._lags)
        if rows is self._all:
            self.state = states
        else:
            self.state = self.state.copy()
            self.state[rows] = states
        return self.state

    def _ago(self, rows: npt.NDArray[np.intp], lags: npt.NDArray[np.int_]) -> Pixels:
        """Return the observations of some environments so many steps ago, (len(rows), len(lags), size, size)."""
        rows = rows[:, np.newaxis]
        return cast(Pixels, self._ring[rows, (self._newest[rows] - lags) % self._ring.shape[1]])
