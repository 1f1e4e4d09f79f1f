"""``clouds.tar``: a group of members for every sample, one sample after another, and an index of them at the end.

The last member, ``__index__``, which WebDataset's readers pass over, holds the keys of the samples, where each ends,
the CRC-32 of each, and at its end 64 bytes that say how long these are and give their SHA-256. So a sample is read
without the others, from a file or by a range of bytes from a server, and whatever is read is known to lie in the
archive.
"""

from __future__ import annotations

import hashlib
import os
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CacheError
from pcdata.files.tar_members import BLOCK, END, member_head, padded

INDEX = "__index__"

_MAGIC = b"pcdata tar 1\n\0\0\0"
_TRAILER = struct.Struct("<QQ32s16s")  # samples, bytes of their keys, SHA-256 of what stands before, the magic
_LONGEST_INDEX = 256 << 20  # bytes: of a million samples it is some 40 MB
_AT_END = 1 << 16  # bytes that are asked for first: the index of a thousand samples
_AT_ONCE = 8 << 20  # bytes of a request, where samples are read one after another

Ranges = Callable[[int, int], "bytes | memoryview"]  # gives the bytes from one place to another


class TarWriter:
    """Write samples to a new archive; it is one after :meth:`finish`. No file is open in between.

    Raises:
        OSError: it exists, or cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._keys: dict[str, None] = {}
        self._ends: list[int] = []
        self._sums: list[int] = []
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "xb"):
            pass

    def add(self, key: str, members: Iterable[tuple[str, Any]]) -> None:
        """Add a sample: the names of its members and their bytes.

        Raises:
            CacheError: the key was added before, or a member has no name or too many bytes.
            OSError: the disk is full.
        """
        if key in self._keys or "\n" in key:
            raise CacheError(f"{self._path}: has a record {key!r:.300} already, or that is no key")
        parts: list[Any] = []
        for name, content in members:
            size = memoryview(content).nbytes
            parts += [member_head(name, size), content, bytes(-size % BLOCK)]
        total = 0
        for part in parts:
            total = zlib.crc32(part, total)
        self._ends.append(self._append(parts))
        self._sums.append(total)
        self._keys[key] = None

    def finish(self) -> None:
        """Write the index and the end, and force all to disk."""
        keys = "\n".join(self._keys).encode("utf-8", "surrogatepass")
        ends, sums = np.array(self._ends, "<i8").tobytes(), np.array(self._sums, "<u4").tobytes()
        content = b"".join((keys, bytes(-len(keys) % 8), ends, sums))
        content += bytes(-(len(content) + _TRAILER.size) % BLOCK)
        trailer = _TRAILER.pack(len(self._ends), len(keys), hashlib.sha256(content).digest(), _MAGIC)
        index = member_head(INDEX, len(content) + _TRAILER.size)
        self._append([index, content, trailer, END], sync=True)

    def _append(self, parts: Sequence[Any], *, sync: bool = False) -> int:
        """Write at the end, and return where that is now."""
        with open(self._path, "ab") as file:
            if file.tell() != (self._ends[-1] if self._ends else 0):
                raise CacheError(f"{self._path}: was changed while it was written")
            for part in parts:
                file.write(part)
            file.flush()
            if sync:
                os.fsync(file.fileno())
            return file.tell()


class TarShard:
    """An archive whose end and index are right; its samples are read when they are asked for.

    Args:
        size: of the archive in bytes.
        ranges: gives bytes of it.
        identity: what tells it from others of its name, if that is known.
        is_mapped: whether its bytes are in memory, so that nothing is gained by reading ahead.

    Raises:
        CacheError: cut short, damaged, or one that claims what cannot be.
    """

    def __init__(self, size: int, ranges: Ranges, identity: tuple[int, ...] | None, *, is_mapped: bool = True) -> None:
        self.identity = identity
        self._ranges = ranges
        self._is_mapped = is_mapped
        keys, self._ends, self._sums = _read_index(size, ranges)
        self._places = {key: place for place, key in enumerate(keys)}
        self._held: dict[int, list[Any]] = {}  # how often, and the bytes
        self._answer: tuple[int, Any] = 0, b""  # where it begins, and what of it may still be asked for
        if len(self._places) != len(keys) or "" in self._places:
            raise CacheError("two samples have one key, or one has none")

    def sample(self, key: str) -> memoryview:
        """Return the members of a sample as they lie in the archive.

        Raises:
            CacheError: there is no such sample, or it cannot be had.
        """
        place = self._place(key)
        held = self._held.get(place)
        if held is not None:
            return held[1]
        part = memoryview(self._ranges(*self._range(place)))
        if not self._is_mapped:
            self._check(place, part)
        return part

    def hold(self, keys: Iterable[str], until: str | None = None) -> None:
        """Read some samples ahead and keep each as often as it is let go; those that follow each other at once.

        With ``until`` the others up to that one will be asked for soon: an answer has as many as are in 8 MiB.

        Raises:
            CacheError: one is missing, cannot be had, or is not what was written.
        """
        if self._is_mapped:
            return
        wanted = Counter(map(self._place, keys))
        places = sorted(wanted)
        for number, place in enumerate(places):
            if place not in self._held:
                last = self._last_at_once(places[number:]) if until is None else self._place(until)
                self._held[place] = [0, self._part(place, last)]
            self._held[place][0] += wanted[place]

    def let_go(self, keys: Iterable[str]) -> None:
        """Forget samples that were held."""
        for place in map(self._place, keys):
            if place in self._held:
                self._held[place][0] -= 1
                if self._held[place][0] < 1:
                    del self._held[place]

    def _last_at_once(self, places: list[int]) -> int:
        """Return the last of the samples that follow the first without a gap."""
        return next((one for one, other in zip(places, [*places[1:], -1]) if other != one + 1), places[0])

    def _part(self, place: int, last: int) -> memoryview:
        """Return a sample's bytes, out of an answer that goes on, up to the ``last`` sample, where it fits."""
        begin, end = self._range(place)
        if not self._answer[0] <= begin < end <= self._answer[0] + len(self._answer[1]):
            self._answer = 0, b""  # not two at a time
            stop = int(np.searchsorted(self._ends[: last + 1], begin + _AT_ONCE, "right"))
            self._answer = begin, self._ranges(begin, max(end, int(self._ends[stop - 1]) if stop else 0))
        first, answer = self._answer
        part = memoryview(bytes(answer[begin - first : end - first]))  # a view would keep the whole answer
        if end - first == len(answer):
            self._answer = 0, b""
        self._check(place, part)
        return part

    def _check(self, place: int, part: memoryview) -> None:
        if zlib.crc32(part) != int(self._sums[place]):
            begin, end = self._range(place)
            raise CacheError(f"its bytes {begin} to {end} are not those that were written; copy it again")

    def _place(self, key: str) -> int:
        place = self._places.get(key)
        if place is None:
            raise CacheError(f"the record {key!r:.300} is missing")
        return place

    def _range(self, place: int) -> tuple[int, int]:
        return int(self._ends[place - 1]) if place else 0, int(self._ends[place])


def _read_index(size: int, ranges: Ranges) -> tuple[list[str], NDArray[np.int64], NDArray[np.uint32]]:
    """Return the keys of the samples, where each ends, and the CRC-32 of each."""
    stop = size - len(END)
    if stop < BLOCK + _TRAILER.size:
        raise CacheError(f"its {size} bytes are no archive of samples")
    begin = max(0, size - _AT_END)
    tail = memoryview(ranges(begin, size))
    count, length, digest, magic = _TRAILER.unpack(tail[stop - _TRAILER.size - begin : stop - begin])
    if magic != _MAGIC or tail[stop - begin :] != END:
        raise CacheError("it does not end as an archive of samples does: cut short, not closed, or something was added")
    content = length + -length % 8 + 12 * count
    whole = padded(content + _TRAILER.size)
    start = stop - whole - BLOCK
    if whole > _LONGEST_INDEX or start < 0:
        raise CacheError(f"its index of {count} samples and {whole} bytes cannot be in an archive of {size} bytes")
    index = tail[start - begin :] if start >= begin else memoryview(ranges(start, stop))
    if index[:BLOCK] != member_head(INDEX, whole):
        raise CacheError("its index is no member of the archive")
    index = index[BLOCK : BLOCK + whole - _TRAILER.size]
    if hashlib.sha256(index).digest() != digest:
        raise CacheError("its index is not what was written")
    ends = np.frombuffer(index, "<i8", count, length + -length % 8)
    sums = np.frombuffer(index, "<u4", count, length + -length % 8 + 8 * count)
    keys = bytes(index[:length]).decode("utf-8", "surrogatepass").split("\n") if count else []
    begins = np.concatenate([np.zeros(1, np.int64), ends])
    if len(keys) != count or int(begins[-1]) != start or bool((np.diff(begins) < BLOCK).any()):
        raise CacheError("its index says that samples lie where they cannot")
    if bool((ends % BLOCK).any()):
        raise CacheError("its index says that samples begin where no member can")
    return keys, ends, sums
