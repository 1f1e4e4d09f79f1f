"""Does each thread have a core of its own right now? A virtual machine may run two of its processors on one core.

A probe, with nothing of pcdata in it: a small product of matrices by one thread alone, then by two at once. On two
cores both take as long; on one core's two hardware threads, or beside another process, the two take up to twice as
long.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import numpy as np
import torch

from pcdata.threads import torch_on_one_thread

OWN = 1.15  # of what one thread takes: below, two threads have a core each
_SIZE, _TIMES = 192, 6


class CoreProbe:
    """Probes between frames, before the first and behind the last."""

    def __init__(self, second: ThreadPoolExecutor) -> None:
        self._second = second
        self._matrix = torch.rand(_SIZE, _SIZE, generator=torch.Generator().manual_seed(0))
        self._alone: list[float] = []
        self._both: list[float] = []

    def look(self) -> None:
        """Probe before the first frame, and behind each."""
        with torch_on_one_thread():
            self._alone.append(self._multiply())
            other = self._second.submit(self._multiply)
            self._both.append(max(self._multiply(), other.result()))

    def look_again(self) -> None:
        """Probe once more before the next frame, as something else was done meanwhile."""
        alone, both = self._alone.pop(), self._both.pop()
        self.look()
        self._alone[-1], self._both[-1] = max(alone, self._alone[-1]), max(both, self._both[-1])

    def _multiply(self) -> float:
        since = time.perf_counter()
        for _ in range(_TIMES):
            torch.mm(self._matrix, self._matrix)
        return time.perf_counter() - since

    def had_own_cores(self) -> list[bool]:
        """Say of each frame whether the probes before and behind it found two cores."""
        fastest = float(np.percentile(self._alone, 10))
        own = [both < OWN * fastest for both in self._both]
        return [before and behind for before, behind in itertools.pairwise(own)]


@contextmanager
def core_probe() -> Iterator[CoreProbe]:
    with ThreadPoolExecutor(1, initializer=torch.set_num_threads, initargs=(1,)) as second:
        yield CoreProbe(second)
