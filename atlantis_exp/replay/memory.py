"""Store observations once, and return transitions by id."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from atlantis_exp.replay.frames import FrameStore

_MAX_BACK = 65_535  # observations; the largest distance an entry can name
_ENTRY_DTYPES: dict[str, type[np.generic]] = {
    "lengths": np.uint32,  # bytes
    "back": np.uint16,
    "action": np.uint8,
    "reward": np.float32,
    "terminal": np.bool_,
}
_SEGMENT_DTYPES = _ENTRY_DTYPES | {"data": np.uint8, "dictionary": np.uint8, "envs": np.int64, "newest": np.int64}


@dataclass(frozen=True)
class Returns:
    """The n-step return of a transition: up to `n_step` rewards, then the value of the state after them.

    The memory keeps the game's rewards. The learner's are those times `scale`, their size to the power of `exponent`,
    clipped to -`clip`..`clip`, summed with discount `gamma` a step. The latest transitions of an episode have fewer
    rewards; after a terminal step no value follows.
    """

    gamma: float
    n_step: int = 1  # steps
    scale: float = 1.0
    exponent: float = 1.0
    clip: float | None = None  # None: not clipped

    def reward(self, r_t: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
        """Turn the game's rewards into the learner's."""
        reward = self.scale * r_t.astype(np.float64)
        if self.exponent != 1:
            reward = np.sign(reward) * np.abs(reward) ** self.exponent
        return reward if self.clip is None else reward.clip(-self.clip, self.clip)


class Transitions(NamedTuple):
    """A batch of B transitions over m steps each; in memory s_t and s_tpm may share frames."""

    s_t: npt.NDArray[np.uint8]  # (B, stack, H, W)
    a_t: npt.NDArray[np.int64]  # (B,)
    r_t: npt.NDArray[np.float32]  # (B,), the discounted sum of m rewards
    s_tpm: npt.NDArray[np.uint8]  # (B, stack, H, W)
    discount: npt.NDArray[np.float32]  # (B,), of the value of s_tpm: gamma**m, 0 after a terminal step


class Window(NamedTuple):
    """The states that an update of a network with a memory sees: T = burn_in + unroll + ahead."""

    burn_in: int  # steps that only recompute the network's memory
    unroll: int  # steps to learn
    ahead: int  # steps after the last, for its n-step return


class Sequences(NamedTuple):
    """A batch of B sequences of T states, of which L follow a burn-in and are learned.

    Before an episode's oldest stored transition its state is repeated, after the latest one the state that followed it;
    actions, rewards and discounts repeat those of the nearest transition.
    """

    states: npt.NDArray[np.uint8]  # (B, T, stack, H, W)
    first: npt.NDArray[np.int64]  # (B,), index of the oldest transition
    last: npt.NDArray[np.int64]  # (B,), index of the latest one to learn
    a_t: npt.NDArray[np.int64]  # (B, L)
    r_t: npt.NDArray[np.float32]  # (B, L), the discounted sum of m rewards
    m: npt.NDArray[np.int64]  # (B, L), steps to the state that is valued next
    discount: npt.NDArray[np.float32]  # (B, L), of its value: gamma**m, 0 after a terminal step


class ReplayMemory:
    """The newest observations of interleaved episodes, each stored once, read as transitions.

    An entry is an observation with the step that led to it: action, reward, whether it is terminal, and `back`, the
    distance in ids to the previous observation (0: an episode's first). Entries never change. A transition has the id
    of its state's newest observation; it is available while it has a successor and all frames from its state's oldest
    to the next state's newest are stored. A state that reaches back beyond its episode repeats the first observation
    (report figure 2.3, `is_new`).

    Args:
        capacity: maximum number of observations; an episode of n steps has n + 1.
        frame_shape: shape of an observation, (H, W).
        lags: how many steps ago each of a state's observations was, ascending from 0.
        budget_bytes: bound on the memory's bytes; if observations compress badly, it forgets them earlier.

    Raises:
        ValueError: capacity or budget is too small for any use.
    """

    def __init__(
        self, capacity: int, frame_shape: tuple[int, int], *, lags: Sequence[int] = range(4), budget_bytes: int
    ) -> None:
        if capacity < (needed := lags[-1] + 2):
            raise ValueError(f"a transition of {needed} observations does not fit a replay capacity of {capacity}")
        self.capacity = capacity
        self.lags = tuple(lags)
        self._reach = lags[-1]  # steps from a state's newest observation back to its oldest
        self._back = np.zeros(capacity, np.uint16)
        self._forward = np.zeros(capacity, np.uint16)
        self._action = np.zeros(capacity, np.uint8)
        self._reward = np.zeros(capacity, np.float32)
        self._terminal = np.zeros(capacity, np.bool_)
        self._available = np.zeros(capacity, np.bool_)
        arrays = (self._back, self._forward, self._action, self._reward, self._terminal, self._available)
        self._index_bytes = sum(array.nbytes for array in arrays)
        self._frames = FrameStore(capacity, frame_shape, budget_bytes - self._index_bytes)
        self._newest: dict[int, int] = {}  # environment -> id of its unfinished episode's newest observation
        self._num_available = 0

    def __len__(self) -> int:
        return self._num_available

    @property
    def oldest_id(self) -> int:
        """Id of the oldest stored observation."""
        return self._frames.oldest_id

    @property
    def next_id(self) -> int:
        """Id of the next observation; the number of observations so far."""
        return self._frames.next_id

    @property
    def nbytes(self) -> int:
        """Bytes in use, at most `budget_bytes`."""
        return self._index_bytes + self._frames.nbytes

    def begin(self, env: int, observation: npt.NDArray[np.uint8]) -> None:
        """Start an episode of environment `env`, whose previous one has ended."""
        self._append(self._frames.encode(observation), back=0, action=0, reward=0.0, terminal=False)
        self._newest[env] = self.next_id - 1

    def add(self, env: int, action: int, reward: float, observation: npt.NDArray[np.uint8], terminal: bool) -> None:
        """Append the step of environment `env` that led to `observation`.

        Raises:
            ValueError: `env` has no episode under way, or the others have appended more than 65,534 observations since.
        """
        if env not in self._newest:
            raise ValueError(f"environment {env} has no episode under way: begin one before adding steps")
        back = self.next_id - self._newest[env]
        if back > _MAX_BACK:
            raise ValueError(f"environment {env} was idle for {back - 1:,} observations: begin a new episode")
        self._append(self._frames.encode(observation), back, action, reward, terminal)
        self._newest[env] = self.next_id - 1

    def draw(self, count: int, rng: np.random.Generator) -> npt.NDArray[np.int64]:
        """Draw `count` available ids uniformly, with replacement. Raises: ValueError if there are none."""
        if not self._num_available:
            raise ValueError("replay holds no transition to draw")
        drawn = np.empty(0, np.int64)
        while len(drawn) < count:
            ids = rng.integers(self.oldest_id, self.next_id, size=count)
            drawn = np.concatenate((drawn, ids[self._available[ids % self.capacity]]))
        return drawn[:count]

    def available(self, ids: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
        """Return which ids are available transitions."""
        return (ids >= self.oldest_id) & (ids < self.next_id) & self._available[ids % self.capacity]

    def completed(self, since: int) -> npt.NDArray[np.int64]:
        """Return the ids of the available transitions whose last observation has an id of at least `since`."""
        ids = np.arange(max(since, self.oldest_id), self.next_id)
        back = self._back[ids % self.capacity]
        previous = (ids - back)[back > 0]
        return previous[self.available(previous)]

    def rewards(self, ids: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
        """Return the rewards of transitions without decoding a frame. Raises: ValueError if one is not available."""
        return self._reward[self._successors(ids) % self.capacity]

    def gather(self, ids: npt.NDArray[np.int64], returns: Returns) -> Transitions:
        """Return transitions. Raises: ValueError if one is not available."""
        a_t, r_t, _, discount, last = self._steps(ids, returns)
        now, then = self._state(ids), self._state(last)
        # Two states one step apart share all frames but one, if they have no gaps.
        overlap = returns.n_step == 1 and len(self.lags) == self._reach + 1
        frames = self._frames.decode(np.vstack((now, then[-1:] if overlap else then)))
        s_t, s_tpm = frames[: len(self.lags)].swapaxes(0, 1), frames[-len(self.lags) :].swapaxes(0, 1)
        return Transitions(s_t, a_t, r_t, s_tpm, discount)

    def gather_sequences(self, ids: npt.NDArray[np.int64], returns: Returns, window: Window) -> Sequences:
        """Return sequences with the transitions of these ids in the middle of their learned part.

        So the ends of episodes are learned half as often as the rest. Raises: ValueError if one is not available.
        """
        self._successors(ids)  # raises for what is not available
        middle, length = window.burn_in + window.unroll // 2, window.burn_in + window.unroll
        chain, first = [ids], np.full(len(ids), middle)  # newest first
        for _ in range(middle):
            previous = chain[-1] - self._back[chain[-1] % self.capacity]
            previous = np.where(self.available(previous), previous, chain[-1])
            first -= previous < chain[-1]
            chain.append(previous)
        chain.reverse()
        while len(chain) < length + window.ahead:
            chain.append(chain[-1] + self._forward[chain[-1] % self.capacity])
        states = np.stack(chain)
        last = middle - 1 + self.available(states[middle:length]).sum(axis=0)
        places = np.minimum(np.arange(window.burn_in, length)[:, np.newaxis], last)
        learned = np.take_along_axis(states, places, axis=0).T
        steps = self._steps(learned.ravel(), returns)
        a_t, r_t, m, discount, _ = (each.reshape(learned.shape) for each in steps)
        observations = self._state(states.ravel()).reshape(len(self.lags), *states.shape)
        needed, places = np.unique(observations.transpose(2, 1, 0), return_inverse=True)
        frames = self._frames.decode(needed)[places.reshape(*states.T.shape, len(self.lags))]
        return Sequences(frames, first, last, a_t, r_t, m, discount)

    def _steps(self, ids: npt.NDArray[np.int64], returns: Returns) -> tuple[npt.NDArray[Any], ...]:
        """Return the action of each transition, its rewards' sum, their number, its discount and its last id."""
        first = last = self._successors(ids)
        r_t = returns.reward(self._reward[first % self.capacity])
        steps = np.ones(len(ids), np.int64)
        for _ in range(returns.n_step - 1):
            forward = self._forward[last % self.capacity]  # 0 at an episode's latest observation
            forward = np.where(self._terminal[last % self.capacity], 0, forward)
            last = last + forward
            reward = returns.reward(self._reward[last % self.capacity])
            r_t += np.where(forward > 0, returns.gamma**steps * reward, 0.0)
            steps += forward > 0
        terminal = self._terminal[last % self.capacity]
        discount = np.where(terminal, 0.0, returns.gamma**steps).astype(np.float32)
        a_t = self._action[first % self.capacity].astype(np.int64)
        return a_t, r_t.astype(np.float32), steps, discount, last

    def segment(self, since: int) -> dict[str, Any]:
        """Return the entries since id `since` for a checkpoint. Raises: ValueError if that lies in the future."""
        if since > self.next_id:
            raise ValueError(f"replay has {self.next_id:,} observations behind it, so none since {since:,}")
        first_id = max(since, self.oldest_id)
        slots = np.arange(first_id, self.next_id) % self.capacity
        lengths, data = self._frames.segment(first_id)
        return {
            "first_id": first_id,
            "oldest_id": self.oldest_id,
            "dictionary": np.frombuffer(bytearray(self._frames.dictionary), np.uint8),
            "data": data,
            "lengths": lengths,
            "back": self._back[slots],
            "action": self._action[slots],
            "reward": self._reward[slots],
            "terminal": self._terminal[slots],
            "envs": np.array(list(self._newest), np.int64),
            "newest": np.array(list(self._newest.values()), np.int64),
        }

    def load_segments(self, segments: Iterable[dict[str, Any]], lost_until: int | None = None) -> None:
        """Restore the memory that wrote `segments`, oldest first; wholly evicted ones may be missing.

        Eviction depends only on the lengths of the entries, so appending them again gives the same memory. Given
        `lost_until`, earlier segments may be lost, too; without any, the memory continues at that id.

        Raises:
            ValueError: a segment is malformed, missing or does not fit; the memory is then unusable.
        """
        self._clear(lost_until or 0, b"")
        oldest_id = 0
        for segment in segments:
            self._load_segment(segment)
            oldest_id = segment["oldest_id"]
        if lost_until is None and self.oldest_id != oldest_id:
            raise ValueError(
                f"replay segments restore observations since {self.oldest_id:,} instead of {oldest_id:,}: "
                "a segment is missing, or the memory is smaller than the one that wrote them"
            )
        self.check_valid()

    def is_under_way(self, env: int) -> bool:
        """Return whether an environment has an unfinished episode."""
        return env in self._newest and self.next_id - self._newest[env] <= _MAX_BACK

    @property
    def highest_action(self) -> int:
        return int(self._action.max())

    def state_dict(self) -> dict[str, Any]:
        """Return the whole memory as one segment."""
        return self.segment(0)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the memory that returned `state`. Raises: ValueError as `load_segments`."""
        self.load_segments([state])

    def check_valid(self) -> None:
        """Compare links and counts with the entries. Raises: ValueError if an invariant fails."""
        ids = np.arange(self.oldest_id, self.next_id)
        slots = ids % self.capacity
        back = self._back[slots].astype(np.int64)
        linked = (back > 0) & (ids - back >= self.oldest_id)
        previous = (ids - back)[linked] - self.oldest_id
        forward = np.zeros(len(ids), np.int64)
        forward[previous] = back[linked]
        reach = ids
        for _ in range(self._reach):
            stored = np.maximum(reach - self.oldest_id, 0)
            reach = np.where(reach >= self.oldest_id, reach - back[stored], reach)
        available = (forward > 0) & (reach >= self.oldest_id)
        newest = np.array([k for k in self._newest.values() if k >= self.oldest_id], np.int64)
        for holds, invariant in (
            (np.all(back <= ids), "no observation comes before id 0"),
            (len(np.unique(previous)) == len(previous), "an observation has one successor at most"),
            (np.array_equal(forward, self._forward[slots]), "forward mirrors back"),
            (np.array_equal(available, self._available[slots]), "available transitions are those wholly stored"),
            (np.count_nonzero(available) == len(self), "the length is the number of available transitions"),
            (len(set(self._newest.values())) == len(self._newest), "no observation belongs to two environments"),
            (np.all(newest < self.next_id), "an environment's newest observation has been seen"),
            (not np.any(self._forward[newest % self.capacity]), "an environment's newest observation has no successor"),
        ):
            if not holds:
                raise ValueError(f"replay memory is not valid: {invariant}")

    def _clear(self, next_id: int, dictionary: bytes) -> None:
        self._frames.clear(next_id, dictionary)
        self._newest = {}
        self._num_available = 0

    def _append(self, data: bytes | memoryview, back: int, action: int, reward: float, terminal: bool) -> None:
        oldest_id = self.oldest_id
        self._frames.append(data)
        for evicted in range(oldest_id, self.oldest_id):
            self._withdraw(evicted)
        k = self.next_id - 1
        slot = k % self.capacity
        self._back[slot] = back
        self._forward[slot] = 0
        self._action[slot] = action
        self._reward[slot] = reward
        self._terminal[slot] = terminal
        self._available[slot] = False
        if back and k - back >= self.oldest_id:
            previous = (k - back) % self.capacity
            self._forward[previous] = back
            if self._state_is_stored(k - back):
                self._available[previous] = True
                self._num_available += 1

    def _state_is_stored(self, k: int) -> bool:
        for _ in range(self._reach):
            k -= self._back.item(k % self.capacity)  # of an entry no longer stored: some distance further back
        return k >= self.oldest_id

    def _withdraw(self, evicted: int) -> None:
        k = evicted
        for _ in range(self._reach + 1):
            slot = k % self.capacity
            self._num_available -= self._available.item(slot)
            self._available[slot] = False
            k += self._forward.item(slot)

    def _state(self, newest: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Return the ids of states' observations, (stack, B), oldest first."""
        newest_first = [newest]
        for _ in range(self._reach):
            newest_first.append(newest_first[-1] - self._back[newest_first[-1] % self.capacity])
        return np.stack([newest_first[lag] for lag in reversed(self.lags)])

    def _successors(self, ids: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        if not np.all(self.available(ids)):
            raise ValueError("replay was asked for a transition that is not available")
        return ids + self._forward[ids % self.capacity]

    def _load_segment(self, segment: dict[str, Any]) -> None:
        for name, dtype in _SEGMENT_DTYPES.items():
            array = segment.get(name)
            if not isinstance(array, np.ndarray) or array.dtype != dtype or array.ndim != 1:
                raise ValueError(f"replay segment: {name} is not a row of {dtype.__name__}")
        for name in ("first_id", "oldest_id"):
            if not isinstance(segment.get(name), int):
                raise ValueError(f"replay segment: {name} is not an int")
        lengths, data, dictionary = segment["lengths"], segment["data"], segment["dictionary"].tobytes()
        if any(len(segment[name]) != len(lengths) for name in _ENTRY_DTYPES):
            raise ValueError("replay segment: its rows differ in length")
        if len(dictionary) != self._frames.frame_bytes and (dictionary or len(lengths)):
            raise ValueError(f"replay segment: it does not hold observations of {self._frames.frame_shape}")
        if np.any(lengths == 0) or np.any(lengths > self._frames.max_length) or np.sum(lengths) != len(data):
            raise ValueError("replay segment: the lengths of its observations do not fit its data")
        if segment["first_id"] != self.next_id or dictionary != self._frames.dictionary:
            self._clear(segment["first_id"], dictionary)
        encoded = data.data
        stops = np.cumsum(lengths, dtype=np.int64).tolist()
        entries = zip(*(segment[name].tolist() for name in _ENTRY_DTYPES), strict=True)
        for stop, (length, *entry) in zip(stops, entries, strict=True):
            self._append(encoded[stop - length : stop], *entry)
        self._newest = dict(zip(segment["envs"].tolist(), segment["newest"].tolist(), strict=True))
