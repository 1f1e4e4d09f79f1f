"""Memory that one frame frees and the next one takes: kept by the process instead of given back and asked for anew."""

from __future__ import annotations

import ctypes
import functools
import os
import sys

from pcdata.kernels.cpu.native import remember_advice

# glibc's names for what is set, from malloc.h; and what is set, in bytes.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_KEPT, _FROM_HEAP = 256 << 20, 32 << 20  # the second is the most that glibc allows
# Whoever sets one of these knows better.
_SET_BY_USER = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "MALLOC_TOP_PAD_", "GLIBC_TUNABLES")


@functools.cache
def keep_freed_memory() -> bool:
    """Let the process keep up to 256 MB that it has freed; return whether that could be set.

    By itself glibc gives the end of its heap back as soon as some megabytes of it are free, and now and then a frame
    has to fetch all its images page by page again: 4 ms for three images of 1280x720. Elsewhere than under glibc, and
    where the environment sets limits of its own, nothing is changed.
    """
    if sys.platform != "linux" or any(os.environ.get(name) for name in _SET_BY_USER):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):  # another library than glibc
        return False
    kept = all([mallopt(_MMAP_THRESHOLD, _FROM_HEAP) == 1, mallopt(_TRIM_THRESHOLD, _KEPT) == 1])
    if kept:
        remember_advice(_FROM_HEAP)
    return kept
