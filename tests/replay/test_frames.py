"""The compressed ring against a plain list of frames."""

import lz4.block
import numpy as np
import numpy.typing as npt
import pytest
from ale_py import ALEInterface, LoggerMode, roms
from hypothesis import given
from hypothesis import strategies as st

from atlantis_exp.replay.frames import FrameStore

SHAPE = (6, 5)
NOISE_BYTES = 30 + 16  # LZ4's bound for 30 incompressible bytes
INDEX_BYTES = 12  # an index entry


def small_store(capacity: int, ring_bytes: int = 8 * NOISE_BYTES) -> FrameStore:
    return FrameStore(capacity, SHAPE, INDEX_BYTES * capacity + ring_bytes + NOISE_BYTES)


def noise(seed: int) -> npt.NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, SHAPE, np.uint8)


@given(
    capacity=st.integers(1, 30),
    ring_bytes=st.integers(8 * NOISE_BYTES, 12 * NOISE_BYTES),
    frames=st.lists(st.one_of(st.integers(0, 999).map(noise), st.just(np.zeros(SHAPE, np.uint8))), max_size=60),
)
def test_the_store_holds_the_longest_run_of_newest_frames_that_fits(
    capacity: int, ring_bytes: int, frames: list[npt.NDArray[np.uint8]]
) -> None:
    store = small_store(capacity, ring_bytes)
    seen: list[tuple[int, npt.NDArray[np.uint8]]] = []
    for frame in frames:
        data = store.encode(frame)
        store.append(data)
        seen.append((len(data), frame))
        held = 0
        while held < min(len(seen), capacity) and sum(size for size, _ in seen[-held - 1 :]) <= ring_bytes:
            held += 1
        assert (store.oldest_id, store.next_id) == (len(seen) - held, len(seen))
        assert store.nbytes == INDEX_BYTES * capacity + sum(size for size, _ in seen[-held:])
        np.testing.assert_array_equal(
            store.decode(np.arange(store.oldest_id, store.next_id)), [kept for _, kept in seen[-held:]]
        )


@pytest.mark.parametrize(("ring_bytes", "held"), [(12 * 32 - 1, 11), (12 * 32, 12)])
def test_the_ring_fills_to_its_last_byte_and_no_further(ring_bytes: int, held: int) -> None:
    store = small_store(40, ring_bytes)
    store.append(store.encode(np.zeros(SHAPE, np.uint8)))
    for seed in range(1, 60):
        data = store.encode(noise(seed))
        assert len(data) == 32
        store.append(data)
        ids = np.arange(max(1, store.next_id - held), store.next_id)
        np.testing.assert_array_equal(store.decode(ids), [noise(k) for k in ids.tolist()])
    assert store.next_id - store.oldest_id == held


def test_a_generous_budget_reserves_what_all_frames_may_take_and_no_more() -> None:
    store = FrameStore(40, SHAPE, 10**15)  # more than any machine has
    for seed in range(100):
        store.append(store.encode(noise(seed)))
    np.testing.assert_array_equal(store.decode(np.arange(60, 100)), [noise(seed) for seed in range(60, 100)])
    assert (store.oldest_id, store.next_id) == (60, 100)
    assert len(store._buffer) == 41 * store.max_length


def test_screens_of_real_play_come_back_byte_for_byte_and_share_their_background() -> None:
    ALEInterface.setLoggerMode(LoggerMode.Error)
    ale = ALEInterface()
    ale.setInt("random_seed", 7)
    rom = roms.get_rom_path("atlantis")
    assert rom
    ale.loadROM(rom)
    rng = np.random.default_rng(7)
    store = FrameStore(500, (210, 160), 1 << 20)
    screens = []
    for _ in range(300):
        ale.act(ale.getMinimalActionSet()[rng.integers(4)])
        screens.append(ale.getScreen())
        store.append(store.encode(screens[-1]))
    ids = rng.permutation(300).reshape(20, 15)
    np.testing.assert_array_equal(store.decode(ids), np.array(screens)[ids])
    lengths, _ = store.segment(0)
    assert lengths.sum() < 0.6 * sum(len(lz4.block.compress(screen, store_size=False)) for screen in screens)


def test_a_stored_frame_never_changes_with_the_array_it_came_from_or_the_one_it_went_to() -> None:
    store = small_store(4)
    frame = noise(1)
    kept = frame.copy()
    store.append(store.encode(frame))
    frame[:] = 0
    store.decode(np.array([0]))[:] = 0
    np.testing.assert_array_equal(store.decode(np.array([0])), [kept])


def test_a_window_on_a_larger_array_is_stored_as_seen() -> None:
    store = small_store(4)
    window = np.arange(120, dtype=np.uint8).reshape(12, 10)[::2, ::2]
    store.append(store.encode(window))
    np.testing.assert_array_equal(store.decode(np.array([0])), [window])


@pytest.mark.parametrize("frame", [np.zeros((5, 6), np.uint8), np.zeros(SHAPE, np.float32)])
def test_a_frame_of_another_shape_or_type_is_refused(frame: npt.NDArray[np.uint8]) -> None:
    with pytest.raises(ValueError, match=r"uint8 frames of \(6, 5\)"):
        small_store(4).encode(frame)


def test_a_budget_below_eight_frames_of_noise_is_refused() -> None:
    with pytest.raises(ValueError, match="does not hold"):
        FrameStore(10, SHAPE, INDEX_BYTES * 10 + 9 * NOISE_BYTES - 1)
