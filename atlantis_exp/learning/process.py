"""Set up a process that learns: torch's threads, determinism, memory."""

import ctypes

import torch

OWN_THREADS = torch.get_num_threads()
"""Torch's default number of threads."""

# malloc.h
_M_TRIM_THRESHOLD = -1
_M_MMAP_MAX = -4


def keep_freed_memory() -> None:
    """Let glibc's malloc keep freed memory for the next allocation; without glibc, do nothing.

    An update frees and allocates hundreds of megabytes. Mapping them again page by page takes 20,000 faults an update
    of ResNetDQN, a sixth of its time on a CPU. In return, the memory of the process never shrinks.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_MAX, 0)
        mallopt(_M_TRIM_THRESHOLD, -1)
