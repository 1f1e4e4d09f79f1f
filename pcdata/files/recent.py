"""Bytes that were made with some work and may be wanted again soon: those used last, within a limit."""

from __future__ import annotations

from collections.abc import Callable, Hashable

_MOST = 64  # values: their sizes are added up each time


class Recent:
    """Bytes by a key, of one process; together no more than a limit, but always those that were used last.

    Without a lock, which a process that is forked would inherit as it is: each step is one of a dictionary's own, and
    two threads at worst make the same bytes twice.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._values: dict[Hashable, bytes] = {}  # in the order of their use

    def get(self, key: Hashable, make: Callable[[], bytes]) -> bytes:
        """Return the bytes of a key, by ``make`` unless they are there."""
        value = self._values.pop(key, None)
        if value is None:
            value = make()
        self._values[key] = value
        count, size = len(self._values), sum(map(len, list(self._values.values())))
        for oldest in list(self._values)[:-1]:
            if count <= _MOST and size <= self._limit:
                break
            count, size = count - 1, size - len(self._values.pop(oldest, b""))
        return value
