"""Which transitions are chosen, and what is looked at to choose them."""

import copy

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from atlantis_exp.faults import Fault
from atlantis_exp.replay.frames import FrameStore
from atlantis_exp.replay.memory import ReplayMemory, Returns
from atlantis_exp.replay.samplers import PrioritizedSampler, Sampler, TopHalfSampler, UniformSampler


def memory_with_rewards(rewards: npt.NDArray[np.float64]) -> ReplayMemory:
    memory = ReplayMemory(len(rewards) + 1, (4, 4), budget_bytes=1 << 20)
    memory.begin(0, np.zeros((4, 4), np.uint8))
    for k, reward in enumerate(rewards):
        memory.add(0, 0, reward, np.full((4, 4), k % 256, np.uint8), False)
    return memory


def test_the_uniform_sampler_draws_once_and_keeps_all() -> None:
    memory = memory_with_rewards(np.arange(100.0))
    ids, weights = UniformSampler().sample(memory, 32, np.random.default_rng(4))
    assert weights is None
    np.testing.assert_array_equal(ids, memory.draw(32, np.random.default_rng(4)))


@pytest.mark.parametrize("oversample", [1, 2, 5])
def test_top_half_is_the_sorted_draw_cut_to_the_batch(oversample: int) -> None:
    rewards = np.random.default_rng(0).choice(np.array([0.0, 0.0, 0.0, 100.0, 200.0, -1.0]), 300)
    memory = memory_with_rewards(rewards)
    for seed in range(20):
        draw = memory.draw(oversample * 16, np.random.default_rng(seed)).tolist()
        expected = sorted(draw, key=lambda k: -rewards[k])[:16]
        ids, weights = TopHalfSampler(oversample).sample(memory, 16, np.random.default_rng(seed))
        assert weights is None
        assert ids.tolist() == expected


@pytest.mark.parametrize(("sampler", "drawn"), [(UniformSampler(), 8), (TopHalfSampler(2), 16)])
def test_a_sampler_chooses_before_any_frame_is_decoded(
    sampler: Sampler, drawn: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    tape: list[tuple[str, int]] = []
    draw, decode = ReplayMemory.draw, FrameStore.decode

    def taped_draw(self: ReplayMemory, count: int, rng: np.random.Generator) -> npt.NDArray[np.int64]:
        tape.append(("draw", count))
        return draw(self, count, rng)

    def taped_decode(self: FrameStore, ids: npt.NDArray[np.int64]) -> npt.NDArray[np.uint8]:
        tape.append(("decode", ids.size))
        return decode(self, ids)

    monkeypatch.setattr(ReplayMemory, "draw", taped_draw)
    monkeypatch.setattr(FrameStore, "decode", taped_decode)
    memory = memory_with_rewards(np.arange(50.0))
    memory.gather(sampler.sample(memory, 8, np.random.default_rng(0)).ids, Returns(0.9))
    assert tape == [("draw", drawn), ("decode", 8 * 5)]


# Prioritized


def test_priorities_decide_how_often_a_transition_comes_and_weights_make_up_for_it() -> None:
    memory, rng = memory_with_rewards(np.arange(10.0)), np.random.default_rng(0)
    sampler = PrioritizedSampler(alpha=0.5, beta=1.0)
    ids, weights = sampler.sample(memory, 10, rng)
    assert ids.tolist() == list(range(10))  # all alike, one from each tenth
    assert weights is not None
    assert weights.tolist() == [1.0] * 10
    errors = np.array([0, 1, 4, 9, 16, 25, 36, 49, 64, 81], np.float32)
    sampler.feed_back(np.arange(10), errors)
    ids, weights = sampler.sample(memory, 45_000, rng)
    assert weights is not None
    counts = np.bincount(ids, minlength=10)
    np.testing.assert_allclose(counts[1:], 1_000 * np.sqrt(errors[1:]), rtol=0.01)
    assert 0 < counts[0] < 5  # an error of nothing may come again
    summed = np.bincount(ids, weights)  # what each counts in all: the same
    np.testing.assert_allclose(summed[1:], summed[1], rtol=0.01)


class NaiveSampler:
    """Keeps a dict of priorities and searches it from one end to the other."""

    def __init__(self) -> None:
        self.priorities: dict[int, float] = {}
        self.highest = 1.0
        self.next_id = 0

    def sample(self, memory: ReplayMemory, count: int, rng: np.random.Generator) -> tuple[list[int], list[float]]:
        available = [k for k in range(memory.oldest_id, memory.next_id) if memory.available(np.array([k]))[0]]
        known = {k: self.priorities.get(k, self.highest) for k in available}
        self.priorities, ids = known, []
        by_slot = sorted(known, key=lambda k: k % memory.capacity)
        total = sum(known.values())
        for stratum, share in enumerate(rng.random(count).tolist()):
            rest = (stratum + share) / count * total
            for k in by_slot:
                rest -= known[k]
                if rest < 0:
                    break
            ids.append(k)
        return ids, [(min(known[j] for j in ids) / known[k]) ** 0.5 for k in ids]

    def feed_back(self, ids: list[int], errors: list[float]) -> None:
        for k, error in zip(ids, errors, strict=True):
            self.priorities[k] = (error + 1e-6) ** 0.7
            self.highest = max(self.highest, self.priorities[k])


@given(
    plays=st.lists(st.tuples(st.integers(0, 2), st.booleans(), st.booleans()), min_size=5, max_size=60),
    rounds=st.lists(st.integers(1, 20), min_size=1, max_size=5),
    seed=st.integers(0, 100),
    reload=st.booleans(),
)
def test_prioritized_draws_are_a_naive_sampler_s(
    plays: list[tuple[int, bool, bool]], rounds: list[int], seed: int, reload: bool
) -> None:
    """While the memory forgets the oldest, and in between the sampler is restored from its state."""
    memory = ReplayMemory(16, (4, 4), lags=[0], budget_bytes=1 << 20)  # where no state is forgotten by half
    sampler, naive, rng = PrioritizedSampler(0.7, 0.5), NaiveSampler(), np.random.default_rng(seed)
    under_way: set[int] = set()
    for count in rounds:
        for env, begins, terminated in plays:
            blank = np.zeros((4, 4), np.uint8)
            if begins or env not in under_way:
                memory.begin(env, blank)
                under_way.add(env)
            else:
                memory.add(env, 0, 0.0, blank, terminated)
                if terminated:
                    under_way.remove(env)
        if not len(memory):
            continue
        state = np.random.default_rng(rng.integers(1 << 30))
        expected, expected_weights = naive.sample(memory, count, copy.deepcopy(state))
        ids, weights = sampler.sample(memory, count, state)
        assert ids.tolist() == expected
        assert weights is not None
        np.testing.assert_allclose(weights.tolist(), expected_weights, rtol=1e-6)
        # A transition that was drawn twice has one error.
        errors = (np.arange(16) % 5 * 0.7).astype(np.float32)[ids % 16]
        sampler.feed_back(ids, errors)
        naive.feed_back(expected, errors.tolist())
        if reload:
            restored = PrioritizedSampler(0.7, 0.5)
            restored.load_state_dict(copy.deepcopy(sampler.state_dict()))
            np.testing.assert_array_equal(restored._tree, sampler._tree)
            sampler = restored


def test_a_transition_whose_first_state_is_half_forgotten_is_not_drawn() -> None:
    memory, rng = ReplayMemory(12, (4, 4), budget_bytes=1 << 20), np.random.default_rng(0)
    sampler = PrioritizedSampler(0.5, 0.5)
    blank = np.zeros((4, 4), np.uint8)
    memory.begin(0, blank)
    for _ in range(40):
        memory.add(0, 0, 0.0, blank, False)
        ids, _ = sampler.sample(memory, 30, rng)
        assert memory.available(ids).all()
    assert set(ids.tolist()) == set(range(memory.oldest_id + 3, memory.next_id - 1))


def test_a_new_transition_has_the_highest_priority_there_was() -> None:
    memory, rng = memory_with_rewards(np.arange(10.0)), np.random.default_rng(0)
    sampler = PrioritizedSampler(1.0, 0.5)
    sampler.sample(memory, 1, rng)
    sampler.feed_back(np.arange(9), np.array([8, *[0] * 8], np.float32))
    sampler.feed_back(np.arange(9), np.zeros(9, np.float32))
    memory.add(0, 0, 0.0, np.zeros((4, 4), np.uint8), False)
    ids, _ = sampler.sample(memory, 9_000, rng)
    newest, of_priority_one = np.count_nonzero(ids == 10), np.count_nonzero(ids == 9)
    assert newest / of_priority_one == pytest.approx(8, rel=0.01)


@pytest.mark.parametrize("poison", [np.nan, np.inf, 1e35])
@pytest.mark.parametrize("alpha", [0.5, 1.0])
@pytest.mark.timeout(60)  # seconds
def test_errors_that_are_no_numbers_do_not_hang_the_search(poison: float, alpha: float) -> None:
    memory, sampler = memory_with_rewards(np.arange(10.0)), PrioritizedSampler(alpha, 0.5)
    sampler.sample(memory, 2, np.random.default_rng(0))
    sampler.feed_back(np.arange(4), np.full(4, poison, np.float32))
    assert np.isfinite(sampler.state_dict()["priorities"].sum())
    PrioritizedSampler(alpha, 0.5).load_state_dict(sampler.state_dict())
    assert len(sampler.sample(memory, 5, np.random.default_rng(0)).ids) == 5


def test_a_prioritized_sampler_of_an_empty_memory_says_so() -> None:
    memory = ReplayMemory(10, (4, 4), budget_bytes=1 << 20)
    with pytest.raises(ValueError, match="no transition"):
        PrioritizedSampler(0.5, 0.5).sample(memory, 1, np.random.default_rng(0))


def test_priorities_of_nothing_do_not_hang_the_search() -> None:
    memory, sampler = memory_with_rewards(np.zeros(15)), PrioritizedSampler(0.5, 0.5)
    sampler.sample(memory, 4, np.random.default_rng(0))
    sampler.load_state_dict({**sampler.state_dict(), "priorities": np.zeros(16)})
    with pytest.raises(Fault, match="do not match the replay memory"):
        sampler.sample(memory, 4, np.random.default_rng(0))
