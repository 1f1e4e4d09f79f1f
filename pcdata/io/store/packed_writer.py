"""Writing ``clouds.packed`` in one pass: see :mod:`pcdata.io.store.packed_file` for its bytes."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CacheError
from pcdata.io.store.packed_file import ALIGNED, DTYPES, END, MAGIC, SCHEMA

_GROUP = 32 << 20  # bytes of records kept in memory until their columns are written

# The facts as a text, and of every array its name, its dtype and the shape of a row.
_Form = tuple[str, tuple[tuple[str, str, tuple[int, ...] | None], ...]]


class PackedWriter:
    """Write records to a new file; it is one after :meth:`finish`. No file is open in between.

    Raises:
        OSError: it exists, or cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._place = len(MAGIC)  # bytes written
        self._held = 0  # bytes in memory
        self._keys: set[str] = set()
        self._waiting: dict[_Form, list[tuple[str, list[NDArray[Any]]]]] = {}
        self._groups: list[dict[str, Any]] = []
        self._tables: list[bytes] = []
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "xb") as file:
            file.write(MAGIC)

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
            if array.dtype.str not in DTYPES:
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
        self._append([*tail, END.pack(begin, len(index), total.digest(), MAGIC)], sync=True)

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
                gap = -place % ALIGNED
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
            self._append([bytes(-self._place % ALIGNED)])

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
