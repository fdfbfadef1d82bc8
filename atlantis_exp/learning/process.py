"""What holds for all of a process that learns: torch's threads, bits that repeat, memory."""

import ctypes

import torch

OWN_THREADS = torch.get_num_threads()
"""Torch's own choice, before anything here changes it."""

# malloc.h
_M_TRIM_THRESHOLD = -1
_M_MMAP_MAX = -4


def set_up_process(threads: int) -> None:
    """Set torch's threads in this process, have it repeat its bits, and keep the memory that it frees."""
    torch.set_num_threads(threads)
    torch.backends.cudnn.deterministic = True  # on a GPU, where else some kernels add in any order
    torch.backends.cudnn.allow_tf32 = False  # there, fp32 is no TensorFloat-32 by another name
    keep_freed_memory()


def keep_freed_memory() -> None:
    """Let glibc's malloc keep freed memory for the next allocation; without glibc, do nothing.

    Every update frees and asks again for hundreds of megabytes, a sixth of its time on a CPU. By default these go back
    to the system, to come again page by page: 20,000 faults an update of ResNetDQN. Holds for the whole process, whose
    memory then never shrinks.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_MAX, 0)
        mallopt(_M_TRIM_THRESHOLD, -1)
