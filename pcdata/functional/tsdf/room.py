"""Memory for voxels, all zero: taken from the system as it is needed, or beforehand."""

from __future__ import annotations

import contextlib
import mmap
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from pcdata.errors import VolumeTooLargeError, is_out_of_memory

LARGEST_TAKE = 64 << 20  # bytes: a chunk of voxels with color, views and labels
_PAGE = 4096  # bytes, or a part of a page where they are larger
_AT_ONCE = 64 << 20  # bytes touched between two chances to interrupt


class _Reserved(NamedTuple):
    memory: Tensor  # uint8; those to touch, and room behind them for the chunk that begins as the last among them
    touched: int  # bytes


class VoxelRoom:
    """The memory of a volume, on one device.

    On the CPU a page, of 2 MB if possible, waits for its writing: the system finds and clears it then, which takes far
    longer than filling it. What was reserved has been written to.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._taken: list[Tensor] = []  # in order
        self._reserved: list[_Reserved] = []  # not yet taken

    @property
    def num_bytes(self) -> int:
        """Bytes taken or reserved."""
        return sum(memory.numel() for memory in self._taken) + sum(one.touched for one in self._reserved)

    def reserve(self, num_bytes: int) -> None:
        """See that so many bytes in all are there, without a copy of what is stored.

        Raises:
            VolumeTooLargeError: the system has not so much memory; what was there before stays.
        """
        missing = num_bytes - self.num_bytes
        if missing > 0:
            if self._taken:
                self._reserved.append(self._reservation(missing))
            else:  # nothing was taken yet: one piece instead of several
                self._reserved = [self._reservation(num_bytes)]
        if self.device.type != "cpu":
            return
        for memory in (*self._taken, *(one.memory[: one.touched] for one in self._reserved)):
            some = memory[:num_bytes].numpy()
            num_bytes -= len(some)
            for start in range(0, len(some), _AT_ONCE):
                some[start : start + _AT_ONCE : _PAGE] |= 0  # a write that changes nothing

    def take(self, count: int) -> Tensor:
        """Return (count,) uint8, all zero; at most ``LARGEST_TAKE``.

        Raises:
            VolumeTooLargeError: the system has not so much memory.
        """
        if self._reserved:
            memory, touched = self._reserved.pop(0)
            if touched > count:
                self._reserved.insert(0, _Reserved(memory[count:], touched - count))
            memory = memory[:count]
        else:
            memory = _zeros(count, self.device)
        self._taken.append(memory)
        return memory

    def _reservation(self, num_bytes: int) -> _Reserved:
        return _Reserved(_zeros(num_bytes + LARGEST_TAKE, self.device), num_bytes)


def _zeros(count: int, device: torch.device) -> Tensor:
    """Return (count,) uint8 whose pages are yet to be found where the system can wait with that."""
    try:
        if device.type != "cpu":
            return torch.zeros(count, dtype=torch.uint8, device=device)
        if not hasattr(mmap, "MADV_HUGEPAGE"):
            return torch.from_numpy(np.zeros(count, np.uint8))
        pages = mmap.mmap(-1, count, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        # A volume grows by tens of megabytes per view: page faults of 4 KB would take longer than filling these.
        with contextlib.suppress(OSError):  # advice only: a system may be built without huge pages
            pages.madvise(mmap.MADV_HUGEPAGE)
        return torch.frombuffer(pages, dtype=torch.uint8)
    except (OSError, OverflowError, MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and not is_out_of_memory(error):
            raise
        raise VolumeTooLargeError(
            f"TSDF: {device} has no {count / 2**20:.1f} MiB for voxels ({error}); use larger voxels or a smaller scene"
        ) from error
