"""Store compressed frames in a ring of bytes."""

import math

import lz4.block
import numpy as np
import numpy.typing as npt

from atlantis_exp.faults import Fault


class FrameStore:
    """Ring of compressed uint8 frames with consecutive ids, in at most `budget_bytes`.

    Every frame is one LZ4 block whose dictionary is the first frame ever encoded: a constant background, half of all
    bytes without a crop, costs next to nothing. Unused memory is reserved but not resident.

    Args:
        capacity: maximum number of frames.
        frame_shape: shape of every frame, (H, W).
        budget_bytes: bound on buffer and index together.

    Raises:
        ValueError: the budget does not hold eight frames of noise, two states of four.
    """

    def __init__(self, capacity: int, frame_shape: tuple[int, ...], budget_bytes: int) -> None:
        self.capacity = capacity
        self.frame_shape = frame_shape
        self.frame_bytes = math.prod(frame_shape)
        self.max_length = self.frame_bytes + self.frame_bytes // 255 + 16  # bytes; LZ4's bound for noise
        self._starts = np.zeros(capacity, np.int64)
        self._lengths = np.zeros(capacity, np.uint32)
        # A frame that begins inside the ring may end beyond it, so that each is contiguous.
        self._ring_bytes = budget_bytes - self._starts.nbytes - self._lengths.nbytes - self.max_length
        if self._ring_bytes < 8 * self.max_length:
            raise ValueError(
                f"a replay budget of {budget_bytes:,} bytes does not hold {capacity:,} index entries "
                f"and eight incompressible {frame_shape} frames"
            )
        self._ring_bytes = min(self._ring_bytes, max(8, capacity) * self.max_length)  # more is never used
        self._buffer = np.empty(self._ring_bytes + self.max_length, np.uint8).data
        self.clear(0, b"")

    def clear(self, next_id: int, dictionary: bytes) -> None:
        """Forget all frames; the next one gets `next_id` and was encoded with `dictionary`."""
        self.oldest_id = next_id
        self.next_id = next_id
        self.dictionary = dictionary
        self._used_bytes = 0
        self._head = 0

    @property
    def nbytes(self) -> int:
        """Bytes in use: index and compressed frames."""
        return self._starts.nbytes + self._lengths.nbytes + self._used_bytes

    def encode(self, frame: npt.NDArray[np.uint8]) -> bytes:
        """Compress one uint8 frame of `frame_shape`; the first one becomes the dictionary. Raises: ValueError."""
        if frame.shape != self.frame_shape or frame.dtype != np.uint8:
            raise ValueError(f"replay holds uint8 frames of {self.frame_shape}, not {frame.dtype} of {frame.shape}")
        frame = np.ascontiguousarray(frame)
        if not self.dictionary:
            self.dictionary = frame.tobytes()
        data: bytes = lz4.block.compress(frame, store_size=False, dict=self.dictionary)
        return data

    def append(self, data: bytes | memoryview) -> None:
        """Store an encoded frame as `next_id`, and evict the oldest until it fits count and bytes."""
        while self.next_id - self.oldest_id == self.capacity or self._used_bytes + len(data) > self._ring_bytes:
            self._used_bytes -= self._lengths.item(self.oldest_id % self.capacity)
            self.oldest_id += 1
        slot = self.next_id % self.capacity
        self._starts[slot] = self._head
        self._lengths[slot] = len(data)
        self._buffer[self._head : self._head + len(data)] = data
        self._used_bytes += len(data)
        self._head = (self._head + len(data)) % self._ring_bytes
        self.next_id += 1

    def decode(self, ids: npt.NDArray[np.int64]) -> npt.NDArray[np.uint8]:
        """Return the frames of stored `ids`, (*ids.shape, *frame_shape). Raises: Fault for damaged bytes."""
        size = self.frame_bytes
        frames = np.empty((*ids.shape, *self.frame_shape), np.uint8)
        target = frames.reshape(-1).data
        for i, (start, stop) in enumerate(self._spans(ids.ravel()).tolist()):
            data = self._buffer[start:stop]
            try:
                frame = lz4.block.decompress(data, uncompressed_size=size, dict=self.dictionary)
                target[i * size : (i + 1) * size] = frame
            except (lz4.block.LZ4BlockError, ValueError) as error:
                raise Fault(
                    f"the replay memory is damaged ({error}); resume=never keeps this run and starts over"
                ) from None
        return frames

    def segment(self, first_id: int) -> tuple[npt.NDArray[np.uint32], npt.NDArray[np.uint8]]:
        """Return the encoded frames since the stored `first_id`: their lengths in bytes, and all their bytes."""
        ids = np.arange(first_id, self.next_id)
        spans = self._spans(ids)
        wraps = np.flatnonzero(spans[1:, 0] != spans[:-1, 1]) + 1
        # Copy whole stretches of the ring: an object a frame would keep the garbage collector busy for seconds.
        stretches = (self._buffer[span[0, 0] : span[-1, 1]] for span in np.split(spans, wraps) if len(span))
        return self._lengths[ids % self.capacity], np.frombuffer(bytearray().join(stretches), np.uint8)

    def _spans(self, ids: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Return start and end in the buffer of the frames of stored `ids`, (N, 2)."""
        slots = ids % self.capacity
        starts = self._starts[slots]
        return np.stack((starts, starts + self._lengths[slots]), axis=1)
