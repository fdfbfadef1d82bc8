"""How the process gets its memory, which an update on a CPU spends a sixth of its time on unless told otherwise."""

import ctypes


def keep_freed_memory() -> None:
    """Let glibc's malloc keep freed memory for the next allocation; without glibc, do nothing.

    Every update frees and asks again for hundreds of megabytes. By default these go back to the system, to come again
    page by page: 20,000 faults an update of ResNetDQN. Holds for the whole process, whose memory then never shrinks.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_MAX, 0)
        mallopt(_M_TRIM_THRESHOLD, -1)


# malloc.h
_M_TRIM_THRESHOLD = -1
_M_MMAP_MAX = -4
