"""Which transitions are chosen, and what is looked at to choose them."""

import numpy as np
import numpy.typing as npt
import pytest

from atlantis_exp.replay.frames import FrameStore
from atlantis_exp.replay.memory import ReplayMemory, Returns
from atlantis_exp.replay.samplers import Sampler, TopHalfSampler, UniformSampler


def memory_with_rewards(rewards: npt.NDArray[np.float64]) -> ReplayMemory:
    memory = ReplayMemory(len(rewards) + 1, (4, 4), budget_bytes=1 << 20)
    memory.begin(0, np.zeros((4, 4), np.uint8))
    for k, reward in enumerate(rewards):
        memory.add(0, 0, reward, np.full((4, 4), k % 256, np.uint8), False)
    return memory


def test_the_uniform_sampler_draws_once_and_keeps_all() -> None:
    memory = memory_with_rewards(np.arange(100.0))
    ids = UniformSampler().sample(memory, 32, np.random.default_rng(4))
    np.testing.assert_array_equal(ids, memory.draw(32, np.random.default_rng(4)))


@pytest.mark.parametrize("oversample", [1, 2, 5])
def test_top_half_is_the_sorted_draw_cut_to_the_batch(oversample: int) -> None:
    rewards = np.random.default_rng(0).choice([0.0, 0.0, 0.0, 100.0, 200.0, -1.0], 300)
    memory = memory_with_rewards(rewards)
    for seed in range(20):
        draw = memory.draw(oversample * 16, np.random.default_rng(seed)).tolist()
        expected = sorted(draw, key=lambda k: -rewards[k])[:16]
        ids = TopHalfSampler(oversample).sample(memory, 16, np.random.default_rng(seed))
        assert ids.tolist() == expected


def test_top_half_doubles_the_share_of_rare_rewards() -> None:
    rewards = np.zeros(1_000)
    rewards[::50] = 100.0  # 2 % of steps, as random play in Atlantis
    memory = memory_with_rewards(rewards)
    uniform, top_half = (
        np.count_nonzero(memory.rewards(sampler.sample(memory, 10_000, np.random.default_rng(1))))
        for sampler in (UniformSampler(), TopHalfSampler())
    )
    assert 1.8 < top_half / uniform < 2.2


@pytest.mark.parametrize(("sampler", "drawn"), [(UniformSampler(), 8), (TopHalfSampler(), 16)])
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
    memory.gather(sampler.sample(memory, 8, np.random.default_rng(0)), Returns(0.9))
    assert tape == [("draw", drawn), ("decode", 8 * 5)]
