"""Transitions by id against whole stacks kept in a list."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chisquare

from atlantis_exp.replay.memory import ReplayMemory, Returns, Transitions, Window

SHAPE = (6, 5)
ONE_STEP = Returns(0.9)
Frame = npt.NDArray[np.uint8]


class Event(NamedTuple):
    """One observation of one environment; an environment without an episode begins one whatever `begins` says."""

    env: int
    begins: bool
    action: int
    reward: float
    terminal: bool
    noise: bool


EVENTS = st.lists(
    st.builds(
        Event,
        env=st.integers(0, 3),
        begins=st.sampled_from([False] * 5 + [True]),
        action=st.integers(0, 3),
        reward=st.sampled_from([0.0, 100.0, 200.0, -1.5]),
        terminal=st.sampled_from([False] * 9 + [True]),
        noise=st.booleans(),
    ),
    max_size=80,
)
CAPACITIES = st.integers(5, 40)
NOISE_BUDGETS = st.sampled_from([9, 12, 1_000])  # frames of noise


LAGS = st.one_of(
    st.integers(1, 4).map(range),
    st.sets(st.integers(1, 12), max_size=4).map(lambda lags: (0, *sorted(lags))),
)


def memory_of(capacity: int, noise_frames: int = 1_000, lags: Sequence[int] = range(4)) -> ReplayMemory:
    return ReplayMemory(capacity, SHAPE, lags=lags, budget_bytes=23 * capacity + 46 * noise_frames)


@dataclass
class Oracle:
    """Keeps every transition whole, for ever, with the ids of the observations it is made of."""

    lags: Sequence[int] = range(4)
    num_observations: int = 0
    episodes: dict[int, list[tuple[int, Frame]]] = field(default_factory=dict)  # each environment's latest, whole
    transitions: dict[int, tuple[set[int], list[Frame], int, float, list[Frame], bool]] = field(default_factory=dict)
    successors: dict[int, int] = field(default_factory=dict)  # of a state's newest observation

    def feed(self, memory: ReplayMemory, event: Event) -> None:
        k = self.num_observations
        observation = np.full(SHAPE, k % 251, np.uint8)
        if event.noise:
            observation = np.random.default_rng(k).integers(0, 256, SHAPE, np.uint8)
        self.num_observations += 1
        if event.begins or event.env not in self.episodes:
            memory.begin(event.env, observation)
            self.episodes[event.env] = [(k, observation)]
            return
        memory.add(event.env, event.action, event.reward, observation, event.terminal)
        state = self.state(event.env)
        self.episodes[event.env] = [*self.episodes[event.env], (k, observation)]
        next_state = self.state(event.env)
        self.transitions[state[-1][0]] = (
            {of for of, _ in state + next_state},
            [frame for _, frame in state],
            event.action,
            event.reward,
            [frame for _, frame in next_state],
            event.terminal,
        )
        self.successors[state[-1][0]] = k

    def state(self, env: int) -> list[tuple[int, Frame]]:
        """Look up what was seen each of so many steps ago; before an episode is its first observation."""
        seen = self.episodes[env]
        return [seen[max(0, len(seen) - 1 - lag)] for lag in reversed(self.lags)]

    def available(self, oldest_id: int) -> list[int]:
        return sorted(k for k, (needs, *_) in self.transitions.items() if min(needs) >= oldest_id)

    def gather(self, ids: list[int], returns: Returns) -> Transitions:
        s_t, a_t, r_t, s_tpm, discount = zip(*(self.transition(k, returns) for k in ids), strict=True)
        return Transitions(
            np.array(s_t, np.uint8),
            np.array(a_t, np.int64),
            np.array(r_t, np.float32),
            np.array(s_tpm, np.uint8),
            np.array(discount, np.float32),
        )

    def transition(self, k: int, returns: Returns) -> tuple[list[Frame], int, float, list[Frame], float]:
        """The steps from k on, one after the other, until there are enough or no more."""
        _, s_t, a_t, *_ = self.transitions[k]
        total, discount = 0.0, 1.0
        for m in range(1, returns.n_step + 1):
            _, _, _, reward, s_tpm, terminal = self.transitions[k]
            reward *= returns.scale
            if returns.clip is not None:
                reward = min(max(reward, -returns.clip), returns.clip)
            total += returns.gamma ** (m - 1) * reward
            discount = 0.0 if terminal else returns.gamma**m
            k = self.successors[k]
            if terminal or k not in self.transitions:
                break
        return s_t, a_t, total, s_tpm, discount


def assert_same_transitions(actual: Transitions, expected: Transitions) -> None:
    for name, column in actual._asdict().items():
        np.testing.assert_array_equal(column, getattr(expected, name), err_msg=name)
        assert column.dtype == getattr(expected, name).dtype


def assert_same_state(actual: dict[str, Any], expected: dict[str, Any]) -> None:
    assert actual.keys() == expected.keys()
    for name, value in actual.items():
        np.testing.assert_array_equal(value, expected[name], err_msg=name)


def played(memory: ReplayMemory, steps: int, seed: int = 0) -> ReplayMemory:
    """Random play of four environments, rewards of their own for every step."""
    rng = np.random.default_rng(seed)
    oracle = Oracle()
    for step in range(steps):
        oracle.feed(
            memory, Event(int(rng.integers(4)), False, step % 4, float(step), rng.random() < 0.05, step % 3 == 0)
        )
    return memory


def available_ids(memory: ReplayMemory) -> npt.NDArray[np.int64]:
    return np.unique(memory.draw(100 * memory.capacity, np.random.default_rng(0)))


@given(
    capacity=CAPACITIES,
    noise_frames=NOISE_BUDGETS,
    lags=LAGS,
    events=EVENTS,
    returns=st.builds(
        Returns,
        gamma=st.sampled_from([0.9, 0.0]),
        n_step=st.integers(1, 6),
        scale=st.sampled_from([1.0, 0.01]),
        clip=st.sampled_from([None, 1.0]),
    ),
)
def test_the_memory_is_the_newest_part_of_a_list_of_whole_transitions(
    capacity: int, noise_frames: int, lags: Sequence[int], events: list[Event], returns: Returns
) -> None:
    capacity = max(capacity, lags[-1] + 2)
    memory, oracle = memory_of(capacity, noise_frames, lags), Oracle(lags)
    for event in events:
        oracle.feed(memory, event)
        memory.check_valid()
        assert memory.next_id == oracle.num_observations
        assert memory.nbytes <= 23 * capacity + 46 * noise_frames
        if noise_frames >= capacity + 1:
            assert memory.oldest_id == max(0, memory.next_id - capacity)
        ids = oracle.available(memory.oldest_id)
        assert len(memory) == len(ids)
        if ids:
            assert_same_transitions(memory.gather(np.array(ids), returns), oracle.gather(ids, returns))
            np.testing.assert_array_equal(memory.rewards(np.array(ids)), oracle.gather(ids, ONE_STEP).r_t)
            assert set(memory.draw(50, np.random.default_rng(0)).tolist()) <= set(ids)
            since = memory.next_id - 5
            assert sorted(memory.completed(since)) == [k for k in ids if oracle.successors[k] >= since]


@given(
    capacity=CAPACITIES,
    noise_frames=NOISE_BUDGETS,
    lags=LAGS,
    events=EVENTS,
    n_step=st.integers(1, 6),
    burn_in=st.integers(0, 8),
    unroll=st.integers(1, 8),
)
def test_a_sequence_is_its_transitions_from_the_oldest_stored_of_the_episode(
    capacity: int, noise_frames: int, lags: Sequence[int], events: list[Event], n_step: int, burn_in: int, unroll: int
) -> None:
    memory, oracle = memory_of(max(capacity, lags[-1] + 2), noise_frames, lags), Oracle(lags)
    for event in events:
        oracle.feed(memory, event)
    ids, returns = oracle.available(memory.oldest_id), Returns(0.9, n_step)
    if not ids:
        return
    before = {oracle.successors[k]: k for k in ids}
    batch = memory.gather_sequences(np.array(ids), returns, Window(burn_in, unroll, n_step))
    assert batch.states.shape == (len(ids), burn_in + unroll + n_step, len(lags), *SHAPE)
    for row, k in enumerate(ids):
        places = {burn_in + unroll // 2: k}
        while (first := min(places)) > 0 and places[first] in before:
            places[first - 1] = before[places[first]]
        while (last := max(places)) + 1 < burn_in + unroll and oracle.successors[places[last]] in oracle.transitions:
            places[last + 1] = oracle.successors[places[last]]
        assert (batch.first[row], batch.last[row]) == (first, last)
        for place in range(burn_in + unroll):
            at = min(max(place, first), last)
            s_t, a_t, r_t, s_tpm, discount = oracle.transition(places[at], returns)
            if place <= last:
                np.testing.assert_array_equal(batch.states[row, place], s_t)
            if place >= burn_in:
                step = row, place - burn_in
                assert (batch.a_t[step], batch.discount[step]) == (a_t, np.float32(discount))
                assert batch.r_t[step] == np.float32(r_t)
                np.testing.assert_array_equal(batch.states[row, at + batch.m[step]], s_tpm)


@pytest.mark.parametrize("returns", [ONE_STEP, Returns(0.9, n_step=3)])
@pytest.mark.parametrize("lags", [range(4), (0, 3), (0, 1, 2, 7)])
def test_a_full_memory_forgets_a_state_with_its_oldest_observation(lags: Sequence[int], returns: Returns) -> None:
    memory, oracle, rng = memory_of(30, lags=lags), Oracle(lags), np.random.default_rng(0)
    for step in range(200):
        begins, ends = rng.random(2) < 0.05
        oracle.feed(memory, Event(int(rng.integers(2)), bool(begins), step % 4, float(step), bool(ends), step % 3 == 0))
        memory.check_valid()
        ids = oracle.available(memory.oldest_id)
        assert len(memory) == len(ids)
        if ids:
            assert_same_transitions(memory.gather(np.array(ids), returns), oracle.gather(ids, returns))
    assert len(ids) >= 10


@given(
    capacity=CAPACITIES,
    noise_frames=NOISE_BUDGETS,
    lags=LAGS,
    events=EVENTS,
    later=EVENTS,
    commits=st.sets(st.integers(0, 80)),
)
def test_a_memory_restored_from_segments_is_and_remains_the_unbroken_one(
    capacity: int,
    noise_frames: int,
    lags: Sequence[int],
    events: list[Event],
    later: list[Event],
    commits: set[int],
) -> None:
    capacity = max(capacity, lags[-1] + 2)
    memory, oracle = memory_of(capacity, noise_frames, lags), Oracle(lags)
    segments, written = [], 0
    for i, event in enumerate(events):
        if i in commits:
            segments.append(memory.segment(written))
            assert segments[-1]["first_id"] == max(written, memory.oldest_id)
            written = memory.next_id
        oracle.feed(memory, event)
    segments.append(memory.segment(written))

    def still_needed() -> Iterator[dict[str, Any]]:
        for segment in segments[:-1]:
            if segment["first_id"] + len(segment["lengths"]) > memory.oldest_id:
                yield segment
        yield segments[-1]

    restored = played(memory_of(capacity, noise_frames, lags), 30)  # to be forgotten
    restored.load_segments(still_needed())
    three = Returns(0.9, n_step=3)
    twin = Oracle(lags, oracle.num_observations, dict(oracle.episodes))
    for i in range(len(later) + 1):
        assert (len(restored), restored.nbytes) == (len(memory), memory.nbytes)
        assert_same_state(restored.state_dict(), memory.state_dict())
        if len(memory):
            ids = memory.draw(20, np.random.default_rng(1))
            np.testing.assert_array_equal(restored.draw(20, np.random.default_rng(1)), ids)
            assert_same_transitions(restored.gather(ids, three), memory.gather(ids, three))
        for event in later[i : i + 1]:
            oracle.feed(memory, event)
            twin.feed(restored, event)


def test_draws_are_uniform_over_the_available_transitions_and_follow_the_generator() -> None:
    memory, oracle = memory_of(60), Oracle()
    rng = np.random.default_rng(5)
    for step in range(200):
        oracle.feed(memory, Event(int(rng.integers(4)), rng.random() < 0.1, 0, 0.0, rng.random() < 0.1, step % 2 == 0))
    ids = oracle.available(memory.oldest_id)
    assert 20 < len(ids) < 55  # a good part of the ring must be rejected
    drawn = memory.draw(20_000, np.random.default_rng(3))
    values, counts = np.unique(drawn, return_counts=True)
    assert values.tolist() == ids
    assert chisquare(counts).pvalue > 0.01
    np.testing.assert_array_equal(memory.draw(20_000, np.random.default_rng(3)), drawn)


def test_the_draws_of_a_batch_are_independent() -> None:
    memory, oracle = memory_of(10), Oracle()
    for step in range(5):
        oracle.feed(memory, Event(0, False, 0, 0.0, False, step % 2 == 0))
    rng = np.random.default_rng(8)
    first, second = np.array([memory.draw(2, rng) for _ in range(4_000)]).T
    assert chisquare(np.bincount(4 * first + second, minlength=16)).pvalue > 0.01


def test_an_empty_memory_has_nothing_to_draw() -> None:
    memory = memory_of(10)
    memory.begin(0, np.zeros(SHAPE, np.uint8))
    assert len(memory) == 0
    with pytest.raises(ValueError, match="no transition"):
        memory.draw(1, np.random.default_rng(0))


def test_a_transition_that_is_not_available_is_refused() -> None:
    memory = played(memory_of(20), 100)
    for k in (*range(memory.oldest_id), *range(memory.next_id - 1, memory.next_id + 20)):
        with pytest.raises(ValueError, match="not available"):
            memory.gather(np.array([memory.draw(1, np.random.default_rng(0))[0], k]), ONE_STEP)
        with pytest.raises(ValueError, match="not available"):
            memory.rewards(np.array([k]))


def test_a_sequence_around_what_is_no_available_transition_is_refused() -> None:
    memory = played(memory_of(30), 60)
    latest = max(memory._newest.values())
    for k in (memory.oldest_id - 1, latest, memory.next_id):
        with pytest.raises(ValueError, match="not available"):
            memory.gather_sequences(np.array([k]), ONE_STEP, Window(2, 4, 1))


def test_no_transition_aliases_the_observations_it_came_from_nor_the_batch_it_went_to() -> None:
    """The report's `stack_frame` shifts in place, so that every stored state of an episode is its last one."""
    memory = memory_of(20)
    observation = np.zeros(SHAPE, np.uint8)
    memory.begin(0, observation)
    for step in range(1, 6):
        observation[:] = step
        memory.add(0, 0, 0.0, observation, False)
    ids = np.arange(5)
    for column in memory.gather(ids, ONE_STEP):
        column[:] = 77
    s_t, _, _, s_tp1, _ = memory.gather(ids, ONE_STEP)
    assert s_t[:, :, 0, 0].tolist() == [[0, 0, 0, 0], [0, 0, 0, 1], [0, 0, 1, 2], [0, 1, 2, 3], [1, 2, 3, 4]]
    assert s_tp1[:, :, 0, 0].tolist() == [[0, 0, 0, 1], [0, 0, 1, 2], [0, 1, 2, 3], [1, 2, 3, 4], [2, 3, 4, 5]]


def test_a_return_ends_with_its_episode_and_is_short_where_the_episode_has_come_no_further() -> None:
    memory = memory_of(40)
    blank = np.zeros(SHAPE, np.uint8)
    for ends in (True, False):  # ids 0 to 3 and 4 to 7; the second is truncated, the third under way
        memory.begin(0, blank)
        for reward in (100.0, 0.0, -200.0):
            memory.add(0, 0, reward, blank, ends and reward < 0)
    memory.begin(0, blank)
    memory.add(0, 0, 400.0, blank, False)
    ids = np.array([0, 1, 2, 4, 5, 6, 8])
    _, _, r_t, _, discount = memory.gather(ids, Returns(0.5, n_step=2))
    assert r_t.tolist() == [100, -100, -200, 100, -100, -200, 400]
    assert discount.tolist() == [0.25, 0, 0, 0.25, 0.25, 0.5, 0.5]
    _, _, r_t, _, _ = memory.gather(ids, Returns(0.5, n_step=2, scale=0.01, exponent=0.5, clip=1.9))
    root = 2**0.5  # a side gun's vessel is worth this much to one of the centre
    np.testing.assert_allclose(r_t, [1, -root / 2, -root, 1, -root / 2, -root, 1.9])


def test_a_step_without_an_episode_is_refused() -> None:
    memory = memory_of(20)
    blank = np.zeros(SHAPE, np.uint8)
    with pytest.raises(ValueError, match="environment 2 has no episode"):
        memory.add(2, 0, 0.0, blank, False)


@pytest.mark.parametrize("idle", [65_534, 65_535])
def test_an_environment_idle_for_too_long_is_refused_before_its_distance_overflows(idle: int) -> None:
    memory = ReplayMemory(70_000, (2, 2), budget_bytes=4 << 20)
    blank = np.zeros((2, 2), np.uint8)
    memory.begin(0, blank)
    memory.begin(1, blank)
    for _ in range(idle - 1):
        memory.add(1, 0, 0.0, blank, False)
    if idle == 65_534:
        memory.add(0, 3, 5.0, blank, False)
        assert memory.gather(np.array([0]), ONE_STEP).r_t.tolist() == [5.0]
        memory.check_valid()
    else:
        with pytest.raises(ValueError, match="environment 0 was idle for 65,535 observations"):
            memory.add(0, 3, 5.0, blank, False)
        assert memory.next_id == idle + 1


def test_capacity_and_budget_too_small_for_a_transition_are_refused() -> None:
    with pytest.raises(ValueError, match="a transition of 5 observations does not fit a replay capacity of 4"):
        memory_of(4)
    with pytest.raises(ValueError, match="does not hold"):
        memory_of(10, noise_frames=8)


def test_a_segment_holds_what_is_stored_and_none_from_the_future() -> None:
    memory = played(memory_of(20), 30)
    assert len(memory.segment(30)["lengths"]) == 0
    assert len(memory.segment(5)["lengths"]) == 20
    with pytest.raises(ValueError, match="none since 31"):
        memory.segment(31)


def test_an_episode_s_first_observation_has_no_step() -> None:
    memory = played(memory_of(40), 30)
    memory.begin(0, np.zeros(SHAPE, np.uint8))
    begun = {name: memory.state_dict()[name][-1].item() for name in ("back", "action", "reward", "terminal")}
    assert begun == {"back": 0, "action": 0, "reward": 0.0, "terminal": False}


def test_the_newest_segments_alone_are_the_memory_without_what_came_before() -> None:
    memory = played(memory_of(100), 30)
    written = memory.next_id
    played(memory, 20)
    rest = played(memory_of(100), 10)  # to be forgotten
    rest.load_segments([memory.segment(written)], memory.next_id)
    assert (rest.oldest_id, rest.next_id) == (written, memory.next_id)
    assert [env for env in range(5) if rest.is_under_way(env)] == [0, 1, 2, 3]
    ids = available_ids(rest)
    assert_same_transitions(rest.gather(ids, ONE_STEP), memory.gather(ids, ONE_STEP))
    rest.load_segments([], 77)
    assert (len(rest), rest.oldest_id, rest.next_id, rest.is_under_way(0)) == (0, 77, 77, False)
    rest.load_segments([])
    assert (len(rest), rest.next_id) == (0, 0)


def _set(name: str, index: int, value: object) -> Callable[[dict[str, Any]], None]:
    def tamper(state: dict[str, Any]) -> None:
        state[name] = state[name].copy()
        state[name][index] = value

    return tamper


def _put(name: str, change: Callable[[Any], Any]) -> Callable[[dict[str, Any]], None]:
    return lambda state: state.update({name: change(state[name])})


@pytest.mark.parametrize(
    ("tamper", "complaint"),
    [
        (lambda state: state.pop("back"), "back is not a row"),
        (lambda state: state.pop("first_id"), "first_id is not an int"),
        (_put("reward", lambda row: row.astype(np.float64)), "reward is not a row of float32"),
        (_put("action", lambda row: row.reshape(2, -1)), "action is not a row"),
        (_put("terminal", lambda row: row[:-1]), "rows differ in length"),
        (_put("data", lambda row: row[:-1]), "do not fit its data"),
        (_put("lengths", lambda row: np.array([0, row[0] + row[1], *row[2:]], np.uint32)), "do not fit its data"),
        (_put("lengths", lambda row: np.array([row.sum() - 11] + [1] * 11, np.uint32)), "do not fit its data"),
        (_put("dictionary", lambda row: row[:-1]), "does not hold observations"),
        (_put("dictionary", lambda row: row[:0]), "does not hold observations"),
        (_put("oldest_id", lambda oldest: oldest + 1), "a segment is missing"),
        (_put("first_id", lambda first: first + 1), "a segment is missing"),
        (lambda state: state.update(first_id=-1, oldest_id=-1), "before id 0"),
        (_set("back", 3, 4), "before id 0"),
        (_set("back", 3, 2), "one successor"),
        (_set("newest", 0, 12), "has been seen"),
        (_set("newest", 0, 5), "has no successor"),
        (lambda state: state.update(envs=np.array([0, 1]), newest=np.array([11, 11])), "two environments"),
        (lambda state: state.update(envs=np.array([0, 1])), "shorter"),
    ],
)
def test_a_corrupt_segment_is_refused(tamper: Callable[[dict[str, Any]], None], complaint: str) -> None:
    line = memory_of(20)
    line.begin(0, np.zeros(SHAPE, np.uint8))
    for step in range(1, 12):
        line.add(0, 1, 1.0, np.full(SHAPE, step, np.uint8), False)
    state = line.state_dict()
    memory_of(20).load_state_dict(dict(state))
    tamper(state)
    with pytest.raises(ValueError, match=complaint):
        memory_of(20).load_state_dict(state)


@pytest.mark.parametrize(
    ("kept_up", "invariant"),
    [("_forward", "forward mirrors back"), ("_available", "wholly stored"), ("_num_available", "the length")],
)
def test_bookkeeping_that_has_drifted_from_the_entries_is_noticed(kept_up: str, invariant: str) -> None:
    memory = played(memory_of(20), 50)
    memory.check_valid()
    setattr(memory, kept_up, getattr(memory, kept_up) ^ True)
    with pytest.raises(ValueError, match=invariant):
        memory.check_valid()


def test_missing_and_disordered_segments_are_refused() -> None:
    memory = memory_of(100)
    segments = []
    for _ in range(3):
        written = memory.next_id
        played(memory, 20, seed=written)
        segments.append(memory.segment(written))
    first, second, third = segments
    memory_of(100).load_segments(segments)
    for wrong in ([first, third], [second, third], [second, first, third], [third, second]):
        with pytest.raises(ValueError, match="a segment is missing"):
            memory_of(100).load_segments(wrong)
    restored = memory_of(100)
    restored.load_segments([first])
    with pytest.raises(ValueError, match="a segment is missing"):
        restored.load_segments([second])


def test_a_memory_too_small_for_the_segments_refuses_them() -> None:
    state = played(memory_of(40), 100).state_dict()
    for smaller in (memory_of(39), memory_of(40, noise_frames=9)):
        with pytest.raises(ValueError, match="smaller"):
            smaller.load_state_dict(state)


def test_segments_of_two_memories_do_not_mix() -> None:
    memory = played(memory_of(100), 20)
    other = memory_of(100)
    other.begin(9, np.ones(SHAPE, np.uint8))
    played(other, 19)
    first = memory.segment(0)
    played(other, 5)
    with pytest.raises(ValueError, match="a segment is missing"):
        memory_of(100).load_segments([first, other.segment(20)])


def test_a_newest_segment_whose_links_contradict_each_other_is_refused() -> None:
    memory = played(memory_of(100), 30)
    written = memory.next_id
    forged = played(memory, 20).segment(written)
    forged["back"] = np.full_like(forged["back"], 1)  # four environments, all of one line
    with pytest.raises(ValueError, match="has no successor"):
        memory_of(100).load_segments([forged], memory.next_id)
