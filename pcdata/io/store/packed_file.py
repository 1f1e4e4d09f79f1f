"""The bytes of ``clouds.packed``: columns of many records, tables that say which rows are whose, and an index.

The file begins with 16 bytes that say what it is. Then come groups of records, about 32 MB each: of every array of its
records there is one block with the rows of all, one record after another, which begins at a multiple of 64 bytes.
Then, at the end, because it is written in one pass: the keys of the records and the row pointers of each group, the
index (JSON), and 64 bytes that say where the tables and the index lie and give the SHA-256 of these.

Whoever opens it compares that hash and the sizes, so every place that is read afterwards lies inside the file. What the
blocks hold is known by the digests of the records in ``dataset.json``.

A plain binary file and no Zarr or Lance: rows are found by two look-ups in a table, a record of a few kilobytes needs
no chunk and no codec, and nothing has to be installed.
"""

from __future__ import annotations

import hashlib
import math
import os
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CacheError
from pcdata.files.mapping import map_file
from pcdata.files.strict_json import json_object
from pcdata.io.store.text_table import LONGEST_TEXT, TextTable

SCHEMA = "pcdata.packed/1"

MAGIC = b"pcdata packed 1\n"
END = struct.Struct("<QQ32s16s")  # where tables and index begin, how long the index is, their SHA-256, the magic
ALIGNED = 64  # bytes: a line of the processor's cache
DTYPES = {np.dtype(code).str for code in ("?", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8")}

_LONGEST_INDEX = 256 << 20  # bytes: of ten million records with a few hundred groups it is a megabyte
_MOST_AXES = 32
_NEW_LINE = 10


@dataclass(frozen=True)
class PackedColumn:
    """One array of all records of a group: (rows, ...), and which rows are whose."""

    values: NDArray[Any]
    begin: int  # where they begin in the file
    each: int | None  # rows of every record, where all have as many
    pointers: NDArray[np.int64] | None  # (records + 1,) otherwise
    is_scalar: bool

    @property
    def form(self) -> tuple[Any, ...]:
        """What must be the same in records that are joined."""
        return self.values.dtype.str, self.values.shape[1:], self.is_scalar

    def rows(self, record: int) -> slice:
        """Return the rows of a record."""
        if self.pointers is None:
            assert self.each is not None
            return slice(record * self.each, (record + 1) * self.each)
        return slice(int(self.pointers[record]), int(self.pointers[record + 1]))


@dataclass(frozen=True)
class PackedGroup:
    """Records with the same arrays and the same facts, of one mapped file."""

    size: int  # records
    facts: dict[str, Any]
    columns: dict[str, PackedColumn]


class PackedFile:
    """A mapped file whose end, index and tables are right; :func:`open_packed` makes it.

    Its records have numbers, group by group.
    """

    def __init__(
        self, content: NDArray[np.uint8], groups: list[PackedGroup], keys: TextTable, identity: tuple[int, ...]
    ) -> None:
        self.content = content
        self.groups = groups
        self.keys = keys
        self.identity = identity
        self._firsts = np.cumsum([0, *(group.size for group in groups)])
        if keys.repeated() is not None:
            raise CacheError("two records have one key")

    def number_of(self, key: str) -> int:
        """Return the number of a record.

        Raises:
            CacheError: there is no such record.
        """
        number = self.keys.place_of(key)
        if number is None:
            raise CacheError(f"the record {key!r:.300} is missing")
        return number

    def record(self, number: int) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Return the facts that a record shares with its group, and its arrays, read-only, as they lie in the file."""
        place = int(np.searchsorted(self._firsts, number, "right")) - 1
        group, row = self.groups[place], number - int(self._firsts[place])
        arrays = {}
        for name, column in group.columns.items():
            values = column.values[column.rows(row)]
            arrays[name] = values.reshape(()) if column.is_scalar else values
        return group.facts, arrays


def open_packed(file: BinaryIO) -> PackedFile:
    """Map an open file.

    Raises:
        CacheError: cut short, damaged, or one that claims what cannot be.
    """
    status = os.fstat(file.fileno())
    size = status.st_size
    if size < len(MAGIC) + END.size or file.read(len(MAGIC)) != MAGIC:
        raise CacheError(f"its {size} bytes do not begin as a packed file of {SCHEMA!r} does")
    file.seek(size - END.size)
    begin, length, digest, magic = END.unpack(file.read(END.size))
    stop = size - END.size
    if magic != MAGIC:
        raise CacheError("it does not end as a packed file does: cut short, not closed, or something was appended")
    if not (len(MAGIC) <= begin <= stop - length and length <= _LONGEST_INDEX):
        raise CacheError(f"its index of {length} bytes behind byte {begin} cannot be in a file of {size} bytes")
    content = map_file(file)
    if len(content) != size or hashlib.sha256(content[begin:stop]).digest() != digest:
        raise CacheError("its tables and index are not what was written")
    index = json_object("its index", bytes(content[stop - length : stop]), error=CacheError)
    if index.get("schema") != SCHEMA:
        raise CacheError(f"schema must be {SCHEMA!r}, got {index.get('schema')!r:.100}")
    groups = index.get("groups")
    if not isinstance(groups, list):
        raise CacheError(f"its index must list groups, got {groups!r:.100}")
    reader = _Reader(content, len(MAGIC), begin, stop - length)
    identity = (status.st_dev, status.st_ino, size, status.st_mtime_ns)
    found = [reader.group(group) for group in groups]
    return PackedFile(np.frombuffer(content, np.uint8), found, reader.keys(), identity)


class _Reader:
    """Take from a mapped file what its index claims, each byte once and in order, so that no claim exceeds the file."""

    def __init__(self, content: memoryview, begin: int, end: int, stop: int) -> None:
        self._content = content
        self._letters: list[NDArray[np.uint8]] = []  # of the keys of each group, and where each ends
        self._ends: list[NDArray[np.int64]] = []
        self._block, self._end = begin, end  # where the next block may begin, and where blocks end
        self._table, self._stop = end, stop  # the same of tables

    def group(self, told: Any) -> PackedGroup:
        """Return a group."""
        records, tables, columns, facts = (_entry(told, name) for name in ("records", "tables", "columns", "facts"))
        if not isinstance(facts, dict):
            raise CacheError(f"the facts of a group must be an object, got {facts!r:.100}")
        if not _is_count(records) or records == 0 or not isinstance(tables, list) or not isinstance(columns, list):
            raise CacheError(f"a group needs records, tables and columns, got {told!r:.200}")
        self._take_keys(_entry(told, "keys"), records)
        pointers = [self._pointers(table, records) for table in tables]
        found: dict[str, PackedColumn] = {}
        for column in columns:
            name = _entry(column, "name")
            if not isinstance(name, str) or name in found:
                raise CacheError(f"the arrays of a group must have a name each, got {name!r:.100}")
            found[name] = self._column(name, column, records, pointers)
        return PackedGroup(records, facts, found)

    def keys(self) -> TextTable:
        """Return the keys of the records of all groups that were read."""
        begins = np.cumsum([0, *(len(letters) for letters in self._letters)])
        ends = [ends + begin for ends, begin in zip(self._ends, begins.tolist())]
        nothing = np.empty(0, np.uint8), np.empty(0, np.int64)
        return TextTable(np.concatenate([nothing[0], *self._letters]), np.concatenate([nothing[1], *ends]))

    def _take_keys(self, place: Any, records: int) -> None:
        """Read the keys of a group, a line each."""
        content = self._taken_table(place)
        letters = np.frombuffer(content, np.uint8)
        is_key = letters != _NEW_LINE
        ends = np.append(np.flatnonzero(~is_key), len(letters))
        ends = ends - np.arange(len(ends))
        lengths = np.diff(ends, prepend=0)
        if len(ends) != records or int(lengths.min()) < 1 or int(lengths.max()) > LONGEST_TEXT:
            raise CacheError(f"a group of {records} records has {len(ends)} keys, or one that is empty or too long")
        try:
            content.decode("utf-8", "surrogatepass")
        except UnicodeDecodeError as error:
            raise CacheError(f"its keys are no text: {error}") from error
        self._letters.append(letters[is_key])
        self._ends.append(ends)

    def _column(self, name: str, told: Any, records: int, pointers: Sequence[NDArray[np.int64]]) -> PackedColumn:
        dtype, row, rows, begin = (_entry(told, entry) for entry in ("dtype", "row", "rows", "begin"))
        if not isinstance(dtype, str) or dtype not in DTYPES:
            raise CacheError(f"array {name!r:.100} has dtype {dtype!r:.100}, which no cloud field has")
        shape = [] if row is None else row
        if not (isinstance(shape, list) and len(shape) < _MOST_AXES and all(map(_is_count, shape))):
            raise CacheError(f"array {name!r:.100} claims rows of shape {row!r:.100}")
        each: Any = rows.get("each") if isinstance(rows, dict) else None
        table: Any = rows.get("table") if isinstance(rows, dict) else None
        if row is None and each != 1:
            raise CacheError(f"array {name!r:.100} is one number of each record, but claims {rows!r:.100}")
        if _is_count(each) and table is None:
            total, own = records * each, None
        elif each is None and _is_count(table) and table < len(pointers):
            own = pointers[table]
            total = int(own[-1])
        else:
            raise CacheError(f"array {name!r:.100} does not say which rows are whose: {rows!r:.100}")
        size = total * math.prod(shape) * np.dtype(dtype).itemsize
        if not _is_count(begin) or begin % ALIGNED or not self._block <= begin <= self._end - size:
            raise CacheError(f"array {name!r:.100} claims {size} bytes at {begin!r:.100}, where they cannot lie")
        self._block = begin + size
        values = np.ndarray((total, *shape), dtype, self._content, begin) if size else np.empty((total, *shape), dtype)
        return PackedColumn(values, begin, None if own is not None else each, own, row is None)

    def _pointers(self, table: Any, records: int) -> NDArray[np.int64]:
        begin, length = self._taken(table)
        if length != 8 * (records + 1):
            raise CacheError(f"a table of row pointers of {records} records has {length} bytes")
        pointers = np.frombuffer(self._content, "<i8", records + 1, begin)
        if pointers[0] != 0 or bool((np.diff(pointers) < 0).any()):
            raise CacheError("row pointers must begin with 0 and never fall")
        return pointers

    def _taken_table(self, place: Any) -> bytes:
        begin, length = self._taken(place)
        return bytes(self._content[begin : begin + length])

    def _taken(self, place: Any) -> tuple[int, int]:
        """Return where a table lies, behind the last one, and how long it is."""
        if not (isinstance(place, list) and len(place) == 2 and all(map(_is_count, place))):
            raise CacheError(f"a table must say where it lies and how long it is, got {place!r:.100}")
        begin, length = place
        if not self._table <= begin <= self._stop - length:
            raise CacheError(f"a table claims {length} bytes at {begin}, where they cannot lie")
        self._table = begin + length
        return begin, length


def _entry(told: Any, name: str) -> Any:
    if not isinstance(told, dict) or name not in told:
        raise CacheError(f"its index must say {name!r} here, got {told!r:.100}")
    return told[name]


def _is_count(value: Any) -> bool:
    return type(value) is int and value >= 0
