"""Many texts in two arrays: their UTF-8 bytes end to end, and where each ends.

No object is made of a text before it is asked for, and what must hold of all of them is looked at with a few passes
over the arrays.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Sequence
from typing import overload

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CacheError

LONGEST_TEXT = 1 << 16  # bytes, of one that can be looked up

_AT_ONCE = 1 << 18  # bytes that are looked at together
_LINE_ENDS = b"\n\r\x0b\x0c\x1c\x1d\x1e"  # where str.splitlines cuts, and beyond ASCII:
_MORE_LINE_ENDS = tuple(end.encode() for end in ("\x85", "\u2028", "\u2029"))
_ODD = np.uint64(0x9E3779B97F4A7C15)


class TextTable(Sequence[str]):
    """Texts, none of which is empty; each is decoded when it is asked for."""

    def __init__(
        self,
        letters: NDArray[np.uint8],
        ends: NDArray[np.int64],  # behind the last byte of each text
    ) -> None:
        self.letters = letters
        self.ends = ends
        self._sorted: tuple[NDArray[np.uint64], NDArray[np.int64]] | None = None  # hashes, and whose each is

    @classmethod
    def of(cls, texts: Iterable[str]) -> TextTable:
        """Return a table of texts."""
        encoded = [text.encode("utf-8", "surrogatepass") for text in texts]
        ends = np.cumsum([len(one) for one in encoded], dtype=np.int64)
        return TextTable(np.frombuffer(b"".join(encoded), np.uint8), ends)

    def part(self, which: range) -> TextTable:
        """Return some texts in a row; the memory is shared."""
        begin = int(self.ends[which.start - 1]) if which.start else 0
        ends = self.ends[which.start : which.stop] - begin
        return TextTable(self.letters[begin : begin + (int(ends[-1]) if len(ends) else 0)], ends)

    def __len__(self) -> int:
        return len(self.ends)

    @overload
    def __getitem__(self, place: int) -> str: ...
    @overload
    def __getitem__(self, place: slice) -> list[str]: ...
    def __getitem__(self, place: int | slice) -> str | list[str]:
        if isinstance(place, slice):
            return [self[number] for number in range(*place.indices(len(self)))]
        number = range(len(self))[place]
        begin = int(self.ends[number - 1]) if number else 0
        return bytes(self.letters[begin : self.ends[number]]).decode("utf-8", "surrogatepass")

    def __iter__(self) -> Iterator[str]:
        for first, stop in self._parts():
            begin = int(self.ends[first - 1]) if first else 0
            letters = self.letters[begin : self.ends[stop - 1]].tobytes()
            ends = (self.ends[first:stop] - begin).tolist()
            for start, end in zip([0, *ends], ends):
                yield letters[start:end].decode("utf-8", "surrogatepass")

    def encoded(self, numbers: NDArray[np.int64]) -> list[bytes]:
        """Return the bytes of some texts."""
        ends = self.ends[numbers]
        begins = np.where(numbers > 0, self.ends[numbers - 1], 0)
        return [self.letters[begin:end].tobytes() for begin, end in zip(begins.tolist(), ends.tolist())]

    def place_of(self, text: object) -> int | None:
        """Return the number of a text, or None."""
        if not isinstance(text, str):
            return None
        if self._sorted is None:
            hashes = self._hashes()
            order = np.argsort(hashes, kind="stable")
            self._sorted = hashes[order], order
        letters = np.frombuffer(text.encode("utf-8", "surrogatepass"), np.uint8)
        if not 0 < len(letters) <= LONGEST_TEXT:
            return None
        wanted = _hashes(letters, np.zeros(1, np.int64))[0]
        hashes, order = self._sorted
        first, stop = (int(np.searchsorted(hashes, wanted, side)) for side in ("left", "right"))
        for number in order[first:stop].tolist():
            if self[number] == text:
                return int(number)
        return None

    def __contains__(self, text: object) -> bool:
        return self.place_of(text) is not None

    def __eq__(self, other: object) -> bool:
        if isinstance(other, TextTable):
            return np.array_equal(self.ends, other.ends) and np.array_equal(self.letters, other.letters)
        if isinstance(other, (list, tuple)):
            return len(self) == len(other) and all(mine == one for mine, one in zip(self, other))
        return NotImplemented

    __hash__ = None  # type: ignore[assignment]  # as of a list

    def check_lines(self, what: str) -> None:
        """Require that every text is UTF-8 in one line.

        Args:
            what: the texts are, in messages, such as "id".

        Raises:
            CacheError: one is not.
        """
        for first, stop in self._parts():
            begin = int(self.ends[first - 1]) if first else 0
            letters = self.letters[begin : self.ends[stop - 1]]
            starts = np.concatenate([np.zeros(1, np.int64), self.ends[first : stop - 1] - begin])
            if bool(((letters[starts] & 0xC0) == 0x80).any()):
                raise CacheError(f"its {what}s are cut inside a letter")
            text = letters.tobytes()
            beyond = not text.isascii()
            try:
                if beyond:
                    text.decode("utf-8", "surrogatepass")
            except UnicodeDecodeError as error:
                raise CacheError(f"its {what}s are no text: {error}") from error
            if len(text.translate(None, _LINE_ENDS)) < len(text) or (
                beyond and any(end in text for end in _MORE_LINE_ENDS)
            ):
                raise CacheError(f"a sample {what} must be a text in one line that is not empty, and one is not")

    def repeated(self) -> str | None:
        """Return a text that is there twice, or None."""
        hashes = self._hashes()
        ordered = np.sort(hashes)
        twice = ordered[1:][ordered[1:] == ordered[:-1]]
        seen = set[str]()
        for number in np.flatnonzero(np.isin(hashes, twice)).tolist() if len(twice) else ():
            if self[number] in seen:
                return self[number]
            seen.add(self[number])
        return None

    def _hashes(self) -> NDArray[np.uint64]:
        found = np.empty(len(self), np.uint64)
        for first, stop in self._parts():
            begin = int(self.ends[first - 1]) if first else 0
            ends = self.ends[first:stop] - begin
            starts = np.concatenate([np.zeros(1, np.int64), ends[:-1]])
            found[first:stop] = _hashes(self.letters[begin : begin + int(ends[-1])], starts)
        return found

    def _parts(self) -> Iterator[tuple[int, int]]:
        """Cut the texts into parts that are looked at together."""
        first = 0
        while first < len(self):
            begin = int(self.ends[first - 1]) if first else 0
            stop = max(first + 1, int(np.searchsorted(self.ends, begin + _AT_ONCE, "right")))
            yield first, stop
            first = stop


@functools.cache
def _powers() -> NDArray[np.uint64]:
    return np.concatenate([np.ones(1, np.uint64), np.full(_AT_ONCE, _ODD).cumprod(dtype=np.uint64)])


def _hashes(letters: NDArray[np.uint8], starts: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Return a 64-bit number of every text; those of equal texts are equal."""
    # A polynomial of the letters whose lowest power depends on where the text starts; the factor lifts all to one.
    sums = np.add.reduceat(np.multiply(letters, _powers()[: len(letters)], dtype=np.uint64), starts)
    return sums * _powers()[_AT_ONCE - starts]
