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
import json
import math
import os
import struct
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from pcdata.errors import CacheError
from pcdata.files.mapping import map_file
from pcdata.files.strict_json import json_object
from pcdata.functional.rows import copy_blocks
from pcdata.io.store.cloud_record import Room

SCHEMA = "pcdata.packed/1"

_MAGIC = b"pcdata packed 1\n"
_END = struct.Struct("<QQ32s16s")  # where tables and index begin, how long the index is, their SHA-256, the magic
_ALIGNED = 64  # bytes: a line of the processor's cache
_GROUP = 32 << 20  # bytes of records kept in memory until their columns are written
_LONGEST_INDEX = 256 << 20  # bytes: of ten million records with a few hundred groups it is a megabyte
_MOST_AXES = 32
_DTYPES = {np.dtype(code).str for code in ("?", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8")}

# The facts as a text, and of every array its name, its dtype and the shape of a row.
_Form = tuple[str, tuple[tuple[str, str, tuple[int, ...] | None], ...]]


class PackedWriter:
    """Write records to a new file; it is one after :meth:`finish`. No file is open in between.

    Raises:
        OSError: it exists, or cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._place = len(_MAGIC)  # bytes written
        self._held = 0  # bytes in memory
        self._keys: set[str] = set()
        self._waiting: dict[_Form, list[tuple[str, list[NDArray[Any]]]]] = {}
        self._groups: list[dict[str, Any]] = []
        self._tables: list[bytes] = []
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "xb") as file:
            file.write(_MAGIC)

    def add(self, key: str, facts: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
        """Add one record; ``facts`` are kept once for all records of a group, which have the same.

        Raises:
            CacheError: the key was added before, or an array is not of plain numbers.
            OSError: the disk is full.
        """
        if key in self._keys or "\n" in key:
            raise CacheError(f"{self._path}: has a record {key!r:.300} already, or that is no key")
        form = []
        for name, array in arrays.items():
            if array.dtype.str not in _DTYPES:
                raise CacheError(f"{self._path}: array {name!r:.300} has dtype {array.dtype}, which no cloud field has")
            form.append((name, array.dtype.str, array.shape[1:] if array.ndim else None))
        self._keys.add(key)
        # Copied: it is the caller's, who may change it before it is written.
        copies = [np.array(array, order="C") for array in arrays.values()]
        text = json.dumps(facts, sort_keys=True, allow_nan=False)
        self._waiting.setdefault((text, tuple(form)), []).append((key, copies))
        self._held += sum(array.nbytes for array in copies)
        if self._held >= _GROUP:
            self._write_waiting()

    def finish(self) -> None:
        """Write what is in memory, the tables and the index, and force all to disk."""
        self._write_waiting()
        begin = self._place
        groups = []
        for group in self._groups:
            groups.append({**group, "keys": self._table(group["keys"])})
            groups[-1]["tables"] = [self._table(table) for table in group["tables"]]
        index = json.dumps({"schema": SCHEMA, "groups": groups}, separators=(",", ":")).encode()
        tail = [*self._tables, index]
        total = hashlib.sha256()
        for part in tail:
            total.update(part)
        self._append([*tail, _END.pack(begin, len(index), total.digest(), _MAGIC)], sync=True)

    def _table(self, content: bytes) -> list[int]:
        """Place a table among those at the end; return where it lies and how long it is."""
        content_place = [self._place + sum(map(len, self._tables)), len(content)]
        self._tables.append(content + bytes(-len(content) % 8))
        return content_place

    def _write_waiting(self) -> None:
        waiting, self._waiting, self._held = self._waiting, {}, 0
        for (facts, form), records in waiting.items():
            parts: list[Any] = []
            columns: list[dict[str, Any]] = []
            tables: list[bytes] = []
            place = self._place
            for number, (name, dtype, row) in enumerate(form):
                arrays = [arrays[number] for _, arrays in records]
                gap = -place % _ALIGNED
                parts += [bytes(gap), *(array.reshape(-1).view(np.uint8) for array in arrays)]
                place += gap
                counts = np.array([len(array) if row is not None else 1 for array in arrays], dtype="<i8")
                rows: Any = {"each": int(counts[0])}
                if (counts != counts[0]).any():
                    table = np.concatenate([np.zeros(1, "<i8"), counts.cumsum()]).astype("<i8").tobytes()
                    if table not in tables:
                        tables.append(table)
                    rows = {"table": tables.index(table)}
                columns.append({"name": name, "dtype": dtype, "row": row, "rows": rows, "begin": place})
                place += sum(array.nbytes for array in arrays)
            keys = "\n".join(key for key, _ in records).encode("utf-8", "surrogatepass")
            group = {"records": len(records), "columns": columns, "keys": keys, "tables": tables}
            self._groups.append({**group, "facts": json.loads(facts)})
            self._append(parts)
        if waiting:
            self._append([bytes(-self._place % _ALIGNED)])

    def _append(self, parts: Sequence[Any], *, sync: bool = False) -> None:
        with open(self._path, "ab") as file:
            if file.tell() != self._place:
                raise CacheError(f"{self._path}: was changed while it was written")
            for part in parts:
                file.write(part)
                self._place += len(part)
            file.flush()
            if sync:
                os.fsync(file.fileno())


@dataclass(frozen=True)
class _Column:
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


class _Group:
    """Records with the same arrays and the same facts, of one mapped file."""

    def __init__(
        self, content: NDArray[np.uint8], keys: list[str], facts: dict[str, Any], columns: dict[str, _Column]
    ) -> None:
        self.content = content  # of the whole file
        self.keys = keys
        self.facts = facts
        self.columns = columns
        self._kinds: dict[Collection[str], tuple[Any, ...]] = {}
        self._tables: dict[Collection[str], NDArray[np.int64]] = {}

    def kind(self, leave_out: Collection[str]) -> tuple[Any, ...]:
        """Return what is the same in groups whose records can be read as one: their facts, and what the arrays are."""
        known = self._kinds.get(leave_out)
        if known is None:
            forms = {name: column.form for name, column in self.columns.items() if name not in leave_out}
            known = self._kinds[leave_out] = json.dumps(self.facts, sort_keys=True), tuple(forms.items())
        return known

    def table(self, leave_out: Collection[str]) -> NDArray[np.int64]:
        """Return where each array begins in the file, and the rows of every record, -1 where these differ: (2, C)."""
        known = self._tables.get(leave_out)
        if known is None:
            columns = [column for name, column in self.columns.items() if name not in leave_out]
            each = [-1 if column.each is None else column.each for column in columns]
            known = self._tables[leave_out] = np.array([[column.begin for column in columns], each], dtype=np.int64)
        return known


class PackedFile:
    """A mapped file whose end, index and tables are right; :func:`open_packed` makes it."""

    def __init__(self, groups: list[_Group], identity: tuple[int, ...]) -> None:
        self._groups = groups
        self.identity = identity
        self._places = {key: (number, row) for number, own in enumerate(groups) for row, key in enumerate(own.keys)}
        if len(self._places) != sum(len(own.keys) for own in groups):
            raise CacheError("two records have one key")

    def place_of(self, key: str) -> Place:
        """Return where a record lies.

        Raises:
            CacheError: there is no such record.
        """
        place = self._places.get(key)
        if place is None:
            raise CacheError(f"the record {key!r:.300} is missing")
        return Place(self._groups[place[0]], place[1])


class Place(NamedTuple):
    """Where a record lies in the mapped file: its group and its number there."""

    group: _Group
    row: int

    @property
    def facts(self) -> dict[str, Any]:
        """What the record has in common with the others of its group."""
        return self.group.facts

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of the record, read-only, as they lie in the file."""
        arrays = {}
        for name, column in self.group.columns.items():
            values = column.values[column.rows(self.row)]
            arrays[name] = values.reshape(()) if column.is_scalar else values
        return arrays


def join_rows(
    places: Sequence[Place], leave_out: Collection[str], room: Room | None = None
) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[np.int64]]] | None:
    """Return each array of some records with its rows one after another, and how many rows are of each record.

    All arrays are laid into memory of ``room``, if that has any. None where the records' facts differ, or their arrays
    in name, dtype or shape of a row, but for those that are left out.
    """
    first, kind = places[0].group, places[0].group.kind(leave_out)
    numbers = {group: number for number, group in enumerate(dict.fromkeys(place.group for place in places))}
    if any(other.kind(leave_out) != kind for other in numbers):
        return None
    forms = [(name, column.values) for name, column in first.columns.items() if name not in leave_out]
    row_bytes = np.array([one.dtype.itemsize * math.prod(one.shape[1:]) for _, one in forms], dtype=np.int64)
    first_rows, counts = _rows_of(places, [name for name, _ in forms], leave_out)
    sizes = counts * row_bytes
    totals = sizes.sum(axis=0)
    begins = np.concatenate([np.zeros(1, np.int64), (totals + -totals % _ALIGNED).cumsum()])
    memory = None if room is None else room(int(begins[-1]))
    if memory is None:
        memory = torch.empty(int(begins[-1]), dtype=torch.uint8, device="cpu")
    copy_blocks(
        memory,
        begins[:-1] + sizes.cumsum(axis=0) - sizes,
        [group.content for group in numbers],
        np.array([numbers[place.group] for place in places])[:, None],
        np.stack([place.group.table(leave_out)[0] for place in places]) + first_rows * row_bytes,
        sizes,
    )
    held, arrays = memory.numpy(), {}
    for (name, one), begin, size, rows in zip(forms, begins.tolist(), totals.tolist(), counts.sum(axis=0).tolist()):
        arrays[name] = held[begin : begin + size].view(one.dtype).reshape(rows, *one.shape[1:])
    return arrays, {name: rows for (name, _), rows in zip(forms, counts.T)}


def _rows_of(
    places: Sequence[Place], names: Sequence[str], leave_out: Collection[str]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first row and the number of rows of each record (R, C), of all arrays."""
    each = np.stack([place.group.table(leave_out)[1] for place in places])
    first = each * np.array([place.row for place in places])[:, None]
    for column in np.flatnonzero((each < 0).any(axis=0)).tolist():
        rows = [place.group.columns[names[column]].rows(place.row) for place in places]
        first[:, column] = [one.start for one in rows]
        each[:, column] = [one.stop - one.start for one in rows]
    return first, each


def open_packed(file: BinaryIO) -> PackedFile:
    """Map an open file.

    Raises:
        CacheError: cut short, damaged, or one that claims what cannot be.
    """
    status = os.fstat(file.fileno())
    size = status.st_size
    if size < len(_MAGIC) + _END.size or file.read(len(_MAGIC)) != _MAGIC:
        raise CacheError(f"its {size} bytes do not begin as a packed file of {SCHEMA!r} does")
    file.seek(size - _END.size)
    begin, length, digest, magic = _END.unpack(file.read(_END.size))
    stop = size - _END.size
    if magic != _MAGIC:
        raise CacheError("it does not end as a packed file does: cut short, not closed, or something was appended")
    if not (len(_MAGIC) <= begin <= stop - length and length <= _LONGEST_INDEX):
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
    reader = _Reader(content, len(_MAGIC), begin, stop - length)
    identity = (status.st_dev, status.st_ino, size, status.st_mtime_ns)
    return PackedFile([reader.group(group) for group in groups], identity)


class _Reader:
    """Take from a mapped file what its index claims, each byte once and in order, so that no claim exceeds the file."""

    def __init__(self, content: memoryview, begin: int, end: int, stop: int) -> None:
        self._content = content
        self._bytes = np.frombuffer(content, np.uint8)
        self._block, self._end = begin, end  # where the next block may begin, and where blocks end
        self._table, self._stop = end, stop  # the same of tables

    def group(self, told: Any) -> _Group:
        """Return a group."""
        records, tables, columns, facts = (_entry(told, name) for name in ("records", "tables", "columns", "facts"))
        if not isinstance(facts, dict):
            raise CacheError(f"the facts of a group must be an object, got {facts!r:.100}")
        if not _is_count(records) or records == 0 or not isinstance(tables, list) or not isinstance(columns, list):
            raise CacheError(f"a group needs records, tables and columns, got {told!r:.200}")
        try:
            keys = self._taken_table(_entry(told, "keys")).decode("utf-8", "surrogatepass").split("\n")
        except UnicodeDecodeError as error:
            raise CacheError(f"its keys are no text: {error}") from error
        if len(keys) != records:
            raise CacheError(f"a group of {records} records has {len(keys)} keys")
        pointers = [self._pointers(table, records) for table in tables]
        found: dict[str, _Column] = {}
        for column in columns:
            name = _entry(column, "name")
            if not isinstance(name, str) or name in found:
                raise CacheError(f"the arrays of a group must have a name each, got {name!r:.100}")
            found[name] = self._column(name, column, records, pointers)
        return _Group(self._bytes, keys, facts, found)

    def _column(self, name: str, told: Any, records: int, pointers: Sequence[NDArray[np.int64]]) -> _Column:
        dtype, row, rows, begin = (_entry(told, entry) for entry in ("dtype", "row", "rows", "begin"))
        if not isinstance(dtype, str) or dtype not in _DTYPES:
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
        if not _is_count(begin) or begin % _ALIGNED or not self._block <= begin <= self._end - size:
            raise CacheError(f"array {name!r:.100} claims {size} bytes at {begin!r:.100}, where they cannot lie")
        self._block = begin + size
        values = np.ndarray((total, *shape), dtype, self._content, begin) if size else np.empty((total, *shape), dtype)
        return _Column(values, begin, None if own is not None else each, own, row is None)

    def _pointers(self, table: Any, records: int) -> NDArray[np.int64]:
        content = self._taken_table(table)
        if len(content) != 8 * (records + 1):
            raise CacheError(f"a table of row pointers of {records} records has {len(content)} bytes")
        pointers = np.frombuffer(content, "<i8").astype(np.int64)
        if pointers[0] != 0 or bool((np.diff(pointers) < 0).any()):
            raise CacheError("row pointers must begin with 0 and never fall")
        return pointers

    def _taken_table(self, place: Any) -> bytes:
        if not (isinstance(place, list) and len(place) == 2 and all(map(_is_count, place))):
            raise CacheError(f"a table must say where it lies and how long it is, got {place!r:.100}")
        begin, length = place
        if not self._table <= begin <= self._stop - length:
            raise CacheError(f"a table claims {length} bytes at {begin}, where they cannot lie")
        self._table = begin + length
        return bytes(self._content[begin : begin + length])


def _entry(told: Any, name: str) -> Any:
    if not isinstance(told, dict) or name not in told:
        raise CacheError(f"its index must say {name!r} here, got {told!r:.100}")
    return told[name]


def _is_count(value: Any) -> bool:
    return type(value) is int and value >= 0
