"""How work is cut up: the threads of the compiled core, how torch's own are kept from waiting, how much goes at once.

Torch splits every operation on more than about 32,000 elements over its OpenMP threads, which meet at a barrier where
they wait awake. With a core of their own that costs microseconds. Where another process has the core, every operation
lasts until the system gives it back, milliseconds later: a hundred operations on an image turn into seconds.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from typing import TypeVar

import torch

One = TypeVar("One")
Other = TypeVar("Other")
Read = TypeVar("Read")

_core_threads: ContextVar[int | None] = ContextVar("core_threads", default=None)


_WIDER = 64


def at_once(device: torch.device, cpu: int) -> int:
    """Return how much is looked at in one go: ``cpu`` on a CPU, where it should stay in a core's cache.

    Elsewhere it is 64 times that: every step of a loop costs a GPU microseconds, and only large steps fill it.
    """
    return cpu if device.type == "cpu" else _WIDER * cpu


def core_threads() -> int:
    """Return how many threads a call of the compiled core may start: torch's number, as the user set it."""
    return _core_threads.get() or torch.get_num_threads()


@contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Run torch's operations on the calling thread alone; the compiled core keeps its threads.

    For long sequences of operations that are short each, such as those on one image. Also a decorator. The number of
    threads is back afterwards. A thread that uses torch for the first time meanwhile takes over the number 1.
    """
    before = torch.get_num_threads()
    if before == 1:
        yield
        return
    token = _core_threads.set(core_threads())
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _core_threads.reset(token)


def in_threads(function: Callable[[One], Other], items: Iterable[One]) -> list[Other]:
    """Return what a function gives for each item, in order; as many at a time as the core may use threads.

    For work of milliseconds in torch, NumPy and the core, which let other threads run meanwhile. The function must not
    change what the others read. Of errors the first in order is raised.
    """
    given = list(items)
    count = min(core_threads(), len(given))
    if count < 2:
        return [function(one) for one in given]
    with torch_on_one_thread(), ThreadPoolExecutor(count) as pool:
        return list(pool.map(function, given))


def while_reading(
    read: Callable[[One], Read], work: Callable[[Read], Other], items: Iterable[One], *, at_once: int = 1
) -> Iterator[Other]:
    """Yield what ``work`` makes of what ``read`` gives for each item, in order, and read the next ones meanwhile.

    Everything is read by the calling thread, as files that are open want it, and an error in reading comes in its
    turn. Where the core may use one thread alone, all happens one after another.

    Args:
        read: what takes an item to what is worked on.
        work: runs in other threads; with ``at_once=1`` in the order of the items, one at a time.
        items: what is gone through.
        at_once: how many are worked on; so many and one more are in memory.
    """
    count = core_threads()
    if count < 2:
        for item in items:
            yield work(read(item))
        return
    apart = copy_context()
    apart.run(_core_threads.set, count)
    at_work: deque[Future[Other]] = deque()
    with ThreadPoolExecutor(at_once) as pool:
        for item in items:
            try:
                with torch_on_one_thread():
                    given = read(item)
            except Exception:
                while at_work:
                    yield at_work.popleft().result()
                raise
            if len(at_work) == at_once:
                yield at_work.popleft().result()
            at_work.append(pool.submit(apart.copy().run, torch_on_one_thread()(work), given))
        while at_work:
            yield at_work.popleft().result()
