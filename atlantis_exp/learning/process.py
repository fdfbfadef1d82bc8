"""Set up a process that learns: torch's threads, determinism, memory."""

import ctypes

import torch

OWN_THREADS = torch.get_num_threads()
"""Torch's default number of threads."""

# malloc.h
_M_TRIM_THRESHOLD = -1
_M_MMAP_MAX = -4


def set_up_process(threads: int) -> None:
    """Set torch's threads, make it deterministic, and keep the memory that it frees."""
    torch.set_num_threads(threads)
    torch.backends.cudnn.deterministic = True  # else some GPU kernels add in any order
    torch.backends.cudnn.allow_tf32 = False  # fp32 means float32, not TensorFloat-32
    keep_freed_memory()


def keep_freed_memory() -> None:
    """Let glibc's malloc keep freed memory for the next allocation; without glibc, do nothing.

    An update frees and allocates hundreds of megabytes. Mapping them again page by page takes 20,000 faults an update
    of ResNetDQN, a sixth of its time on a CPU. In return, the memory of the process never shrinks.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_MAX, 0)
        mallopt(_M_TRIM_THRESHOLD, -1)
