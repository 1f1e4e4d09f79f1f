"""Files that stay open from one sample to the next: opened when they are first asked for, in each process anew."""

from __future__ import annotations

import os
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

Handle = TypeVar("Handle")

# What came through fork: it shares its place in the file with the parent, and closing it may wait for threads that
# only the parent has. So it is neither used nor closed.
_INHERITED: list[Any] = []


class Handles:
    """Open files by a key, the ``most`` that were used last; a pickled copy has none.

    One thread at a time uses them: a decoder has one place in its file.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._start()

    def _start(self) -> None:
        self._open: OrderedDict[Hashable, Any] = OrderedDict()
        self._lock = threading.RLock()
        self._process = os.getpid()
        self._at_end = weakref.finalize(self, _close_all, self._open, self._process)

    @contextmanager
    def using(self, key: Hashable, opened: Callable[[], Handle]) -> Iterator[Handle]:
        """Give the handle of a key, opened by ``opened`` unless it is; whatever fails while it is used closes it."""
        if self._process != os.getpid():
            self._at_end.detach()
            _INHERITED.append((self._open, self._lock))
            self._start()
        with self._lock:
            if key not in self._open:
                self._open[key] = opened()
                while len(self._open) > self._most:
                    _close(self._open.popitem(last=False)[1])
            self._open.move_to_end(key)
            try:
                yield self._open[key]
            except BaseException:
                _close(self._open.pop(key, None))
                raise

    def __getstate__(self) -> dict[str, Any]:
        return {"_most": self._most}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._most = state["_most"]
        self._start()


def _close_all(opened: OrderedDict[Hashable, Any], process: int) -> None:
    if process == os.getpid():
        for handle in opened.values():
            _close(handle)
        opened.clear()


def _close(handle: Any) -> None:
    if handle is not None:
        handle.close()
