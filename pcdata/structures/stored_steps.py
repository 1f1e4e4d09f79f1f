"""The histories of clouds, which training carries along and seldom reads: put together when somebody does.

So a step of a batch is noted once, and not in a dictionary for each of its clouds, and what a file says is not parsed.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Protocol

from pcdata.errors import CacheError
from pcdata.files.strict_json import parse_json

Step = dict[str, Any]


class OfClouds(Protocol):
    """Something of each of B clouds in a row."""

    def __len__(self) -> int: ...
    def __getitem__(self, clouds: slice, /) -> Any: ...
    def __iter__(self) -> Iterator[Any]: ...


class StoredSteps:
    """The steps of B clouds as JSON texts, a list each."""

    __slots__ = ("_texts",)

    def __init__(self, texts: Sequence[bytes]) -> None:
        self._texts = texts

    def __len__(self) -> int:
        return len(self._texts)

    def __getitem__(self, clouds: slice) -> StoredSteps:
        return StoredSteps(self._texts[clouds])

    def __iter__(self) -> Iterator[list[Step]]:
        """Read them.

        Raises:
            CacheError: a text is no JSON list.
        """
        return map(_parsed, self._texts)


def _parsed(text: bytes) -> list[Step]:
    try:
        stored = parse_json(text)
    except ValueError as error:
        raise CacheError(f"the history of a cloud is damaged: {error!s:.300}; rebuild the dataset") from error
    if not isinstance(stored, list):
        raise CacheError("the history of a cloud must be a list of steps; rebuild the dataset")
    return stored


class Histories:
    """The steps of B clouds: what some already have, of batch after batch, and then more, each a step of all."""

    __slots__ = ("_more", "_parts")

    def __init__(self, parts: Iterable[OfClouds], more: Iterable[OfClouds] = ()) -> None:
        self._parts = tuple(parts)
        self._more = tuple(more)

    def then(self, step: OfClouds) -> Histories:
        """Return them with one more step of each cloud."""
        return Histories(self._parts, (*self._more, step))

    def __len__(self) -> int:
        return sum(map(len, self._parts))

    def __getitem__(self, clouds: slice) -> Histories:
        begin, stop, _ = clouds.indices(len(self))
        parts, first = [], 0
        for part in self._parts:
            if first < stop and begin < first + len(part):
                parts.append(part[max(begin - first, 0) : stop - first])
            first += len(part)
        return Histories(parts, [step[begin:stop] for step in self._more])

    def __iter__(self) -> Iterator[tuple[Step, ...]]:
        """Read the steps of each cloud.

        Raises:
            CacheError: what was stored is no list of steps.
        """
        for steps, *more in zip(itertools.chain.from_iterable(self._parts), *self._more, strict=True):
            yield (*steps, *more)
