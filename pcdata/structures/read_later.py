"""The meta and the histories of clouds, which training carries along and seldom reads: put together when somebody does.

So a step of a batch is noted once, and not in a dictionary for each of its clouds, and what a file says is not parsed.
"""

from __future__ import annotations

import itertools
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CacheError
from pcdata.files.strict_json import parse_json

Step = dict[str, Any]
F = TypeVar("F", bound="_Facts")


class OfClouds(Protocol):
    """Something of each of B clouds in a row."""

    def __len__(self) -> int: ...
    def __getitem__(self, clouds: slice, /) -> Any: ...
    def __iter__(self) -> Iterator[Any]: ...


# -- as they were stored -----------------------------------------------------------------------------------------------


class StoredTexts:
    """Texts of B clouds end to end; it may be memory of a batch that holds their bytes."""

    __slots__ = ("ends", "letters")

    def __init__(
        self,
        letters: NDArray[np.uint8],
        ends: NDArray[np.int64],  # (B,) behind the last byte of each
    ) -> None:
        self.letters = letters
        self.ends = ends

    @classmethod
    def of(cls, texts: Sequence[bytes]) -> StoredTexts:
        """Return such texts."""
        lengths = [len(text) for text in texts]
        return cls(np.frombuffer(b"".join(texts), np.uint8), np.cumsum(lengths, dtype=np.int64))

    def __len__(self) -> int:
        return len(self.ends)

    def __getitem__(self, clouds: slice) -> StoredTexts:
        first, stop, _ = clouds.indices(len(self))
        begin = int(self.ends[first - 1]) if first else 0
        ends = self.ends[first:stop] - begin
        return StoredTexts(self.letters[begin : begin + int(ends[-1])] if len(ends) else self.letters[:0], ends)

    def __iter__(self) -> Iterator[bytes]:
        ends = self.ends.tolist()
        return (self.letters[begin:end].tobytes() for begin, end in zip([0, *ends], ends))

    def __reduce__(self) -> tuple[Any, ...]:
        return texts_from_bytes, (self.letters.tobytes(), self.ends.tobytes())


def texts_from_bytes(letters: bytes | memoryview, ends: bytes) -> StoredTexts:
    """Return texts of their bytes, and of the bytes of their ends."""
    return StoredTexts(np.frombuffer(letters, np.uint8), np.frombuffer(ends, np.int64))


class _Stored:
    """What JSON texts say of B clouds."""

    __slots__ = ("texts",)

    def __init__(self, texts: StoredTexts) -> None:
        self.texts = texts

    def __len__(self) -> int:
        return len(self.texts)

    def __getitem__(self: Any, clouds: slice) -> Any:
        return type(self)(self.texts[clouds])

    def __iter__(self) -> Iterator[Any]:
        raise NotImplementedError


class StoredSteps(_Stored):
    """The steps of B clouds as JSON texts, a list each in a list of its own: what a record of one cloud stores."""

    __slots__ = ()

    def __iter__(self) -> Iterator[list[Step]]:
        """Read them.

        Raises:
            CacheError: a text is no such list.
        """
        for text in self.texts:
            (steps,) = _parsed("history", text, list, lambda stored: stored)
            yield steps


class StoredMeta(_Stored):
    """The meta of B clouds as JSON texts, each the facts of a record of one cloud."""

    __slots__ = ()

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """Read them.

        Raises:
            CacheError: a text is not such facts.
        """
        for text in self.texts:
            (meta,) = _parsed("meta", text, dict, lambda stored: stored.get("meta"))
            yield meta


def _parsed(name: str, text: bytes, kind: type, told: Any) -> list[Any]:
    try:
        stored = told(parse_json(text))
    except (ValueError, AttributeError) as error:
        raise CacheError(f"the {name} of a cloud is damaged: {error!s:.300}; rebuild the dataset") from error
    if not (isinstance(stored, list) and len(stored) == 1 and isinstance(stored[0], kind)):
        raise CacheError(f"the {name} of a cloud must be a {kind.__name__}, got {stored!r:.100}; rebuild the dataset")
    return stored


class MadeWhenRead:
    """Facts of each of B clouds that cost something to find out: found out when somebody reads them."""

    __slots__ = ("__weakref__", "_count", "_found", "_make")

    def __init__(self, count: int, make: Callable[[], Sequence[Step]]) -> None:
        self._count = count
        self._make: Callable[[], Sequence[Step]] | None = make
        self._found: Sequence[Step] = ()

    def __len__(self) -> int:
        return self._count

    def find_out(self) -> Sequence[Step]:
        """Return them, and keep them from now on instead of what tells them."""
        make = self._make
        if make is not None:  # another thread that asks meanwhile finds out the same
            self._found = make()
            self._make = None  # and the memory that it looked at
        return self._found

    def __getitem__(self, clouds: slice) -> MadeWhenRead:
        return MadeWhenRead(len(range(*clouds.indices(self._count))), lambda: self.find_out()[clouds])

    def __iter__(self) -> Iterator[Step]:
        return map(dict, self.find_out())

    def __reduce__(self) -> tuple[Any, ...]:
        return list, (list(self),)


_MOST_WAITING = 4
_waiting: deque[weakref.ref[MadeWhenRead]] = deque()


def put_off(facts: MadeWhenRead) -> MadeWhenRead:
    """Return facts that hold much memory until they are read: those that were put off long before are found out now.

    So clouds whose facts nobody reads cost no time if they go soon, and little memory if they stay.
    """
    _waiting.append(weakref.ref(facts))
    while len(_waiting) > _MOST_WAITING:
        oldest = _waiting.popleft()()
        if oldest is not None:
            oldest.find_out()
    return facts


# -- as clouds hold them -----------------------------------------------------------------------------------------------


class _Facts:
    """Facts of B clouds: what some already have, of batch after batch, and then more, each of all of them."""

    __slots__ = ("_more", "_parts")

    stored: ClassVar[type[_Stored]]

    def __init__(self, parts: Iterable[OfClouds], more: Iterable[OfClouds] = ()) -> None:
        self._parts = tuple(parts)
        self._more = tuple(more)

    def then(self: F, more: OfClouds) -> F:
        """Return them with something more of each cloud."""
        return type(self)(self._parts, (*self._more, more))

    def __len__(self) -> int:
        return sum(map(len, self._parts))

    def __getitem__(self: F, clouds: slice) -> F:
        begin, stop, _ = clouds.indices(len(self))
        parts, first = [], 0
        for part in self._parts:
            if first < stop and begin < first + len(part):
                parts.append(part[max(begin - first, 0) : stop - first])
            first += len(part)
        return type(self)(parts, [step[begin:stop] for step in self._more])

    def __iter__(self) -> Iterator[Any]:
        """Read those of each cloud.

        Raises:
            CacheError: what was stored is something else.
        """
        for own, *more in zip(itertools.chain.from_iterable(self._parts), *self._more, strict=True):
            yield self._together(own, more)

    @staticmethod
    def _together(own: Any, more: Sequence[Any]) -> Any:
        raise NotImplementedError


class Histories(_Facts):
    """The steps of B clouds, of each a tuple."""

    __slots__ = ()

    stored = StoredSteps

    @staticmethod
    def _together(own: Sequence[Step], more: Sequence[Step]) -> tuple[Step, ...]:
        return (*own, *more)


class Metas(_Facts):
    """The meta of B clouds, of each a dictionary."""

    __slots__ = ()

    stored = StoredMeta

    @staticmethod
    def _together(own: Mapping[str, Any], more: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        together = dict(own)
        for one in more:
            together.update(one)
        return together

    def at_hand(self, b: int) -> dict[str, Any]:
        """Return what is told of a cloud without finding anything out."""
        one = self[b : b + 1]
        more = (step for step in one._more if not isinstance(step, MadeWhenRead))
        (own,) = itertools.chain.from_iterable(one._parts)
        return self._together(own, [next(iter(step)) for step in more])


def meta_at_hand(clouds: Any, b: int) -> Mapping[str, Any]:
    """Return what the meta of one of some clouds tells without finding anything out: who they are, and alike."""
    held = vars(clouds)["meta"]
    return held.at_hand(b) if isinstance(held, Metas) else held[b]


class ReadLater:
    """An attribute of clouds with a fact of each: a tuple, as everybody sees it.

    ``vars(clouds)[name]`` is what they hold: :class:`Histories`, or :class:`Metas`, where nobody has read it yet.
    """

    def __init__(self, kind: type[_Facts]) -> None:
        self._kind = kind

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, clouds: Any, owner: type) -> Sequence[Any]:
        if clouds is None:
            return ()  # the default, as dataclasses ask for it
        held: Any = vars(clouds)[self._name]
        if isinstance(held, self._kind):
            held = vars(clouds)[self._name] = tuple(held)
        return held

    def __set__(self, clouds: Any, value: Any) -> None:
        vars(clouds)[self._name] = self._kind([value]) if isinstance(value, self._kind.stored) else value
