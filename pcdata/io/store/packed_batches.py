"""Records of many packed files read as one: their rows are looked up all at once, and copied once."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.functional.stored_rows import (
    CLOUDS,
    OTHERS,
    Role,
    StoredForm,
    StoredGroups,
    find_records,
    gather_records,
    parts_of,
)
from pcdata.io.store.cloud_record import DERIVED, Record, Room
from pcdata.io.store.joined_record import is_per_point, joined_record, signals_are_arrays
from pcdata.io.store.packed_file import PackedColumn, PackedFile, PackedGroup
from pcdata.io.store.store import INFO
from pcdata.structures.read_later import StoredMeta, StoredSteps, StoredTexts

# What clouds hold of these fields as it is stored: a file may have other dtypes, which clouds do not.
_PLAIN = {
    "points": (np.dtype(np.float32), (3,)),
    "colors": (np.dtype(np.float32), (3,)),
    "source_index": (np.dtype(np.int64), ()),
}
HISTORY = f"{INFO}.history"  # apart from the other facts: it is long, and seldom read


class PackedBatches:
    """The records of the packed files that a process has met: each has a number, its place."""

    def __init__(self) -> None:
        self._files: dict[int, tuple[PackedFile, int]] = {}  # by their id, which they keep: with their first place
        self._num_records = 0
        self._firsts = _Grown(np.int64)  # (G,) the first place of each group
        self._which = _Grown(np.int64, 2)  # (G, 2) its form, and its number among those of the form
        self._forms: dict[Any, _Form] = {}
        self._pointers = _Grown(np.int64)  # those of all columns whose records differ in their rows
        self._groups = StoredGroups(self._firsts.tensor, self._which.tensor, self._pointers.tensor)

    def places_in(self, file: PackedFile) -> int:
        """Return the place of a file's first record; the others follow."""
        known = self._files.get(id(file))
        if known is None:
            known = self._files[id(file)] = file, self._num_records
            for group in file.groups:
                self._add(file, group)
        return known[1]

    def _add(self, file: PackedFile, group: PackedGroup) -> None:
        columns = {name: column for name, column in group.columns.items() if name not in DERIVED}
        kind = json.dumps(group.facts, sort_keys=True), tuple((name, one.form) for name, one in columns.items())
        form = self._forms.get(kind)
        if form is None:
            form = self._forms[kind] = _Form(len(self._forms), group.facts, columns)
        pointers = {id(one.pointers): one.pointers for one in columns.values() if one.pointers is not None}
        first = {key: self._pointers.add(table) for key, table in pointers.items()}
        begin = file.content.__array_interface__["data"][0]
        place = form.tables.add(
            [
                [
                    (
                        begin + one.begin,
                        0 if one.each is None else one.each,
                        -1 if one.pointers is None else first[id(one.pointers)],
                    )
                    for one in columns.values()
                ]
            ]
        )
        self._firsts.add([self._num_records])
        self._which.add([[form.number, place]])
        self._num_records += group.size
        form.update()
        self._groups = StoredGroups(self._firsts.tensor, self._which.tensor, self._pointers.tensor)

    def read(
        self, places: NDArray[np.int64], room: Room | None = None, *, leave: Collection[str] = ()
    ) -> Record | None:
        """Return the record of all clouds in a row; None where facts differ, or arrays in name, dtype or row.

        Arrays to ``leave`` stay where they lie, if each record is one cloud, and they are what clouds hold.
        """
        forms = list(self._forms.values())
        form = forms[0] if len(forms) == 1 else forms[self._form_of(int(places[0]))]
        groups, stored = self._groups, form.stored
        table = find_records(torch.from_numpy(places), groups, stored)
        found = parts_of(table, len(form.names), len(places))
        if found.kind == OTHERS:
            return None
        starts = found.starts.tolist()
        memory = None if room is None else room(starts[-1])
        if memory is None:
            memory = torch.empty(starts[-1], dtype=torch.uint8, device="cpu")
        sources = None
        if leave and found.kind == CLOUDS:
            left = {name: column for name, column in form.plain.items() if name in leave}
            sources = {name: found.sources[column] for name, column in left.items()}
            found.sizes[[*left.values()]] = 0  # nothing is copied
        gather_records(memory, stored, table)
        totals = found.ends[:, -1].tolist()
        if found.kind == CLOUDS:
            totals[found.pointers] = len(places) + 1
        arrays = form.arrays(memory, starts, totals)
        owns, histories = (
            StoredTexts(arrays.pop(name), found.ends[form.names.index(name)]) for name in (INFO, HISTORY)
        )
        if found.kind == CLOUDS:
            facts = {**form.facts, "meta": StoredMeta(owns), "history": StoredSteps(histories)}
            return Record(arrays, facts, form, sources)
        rows = dict(zip(form.names, np.diff(found.ends, prepend=0)))
        record = joined_record(arrays, {name: rows[name] for name in arrays}, form.facts, owns, histories)
        return record if record is None else Record(record.arrays, record.info, form)

    def _form_of(self, place: int) -> int:
        """Return the number of the form of a record."""
        return int(self._which.rows[np.searchsorted(self._firsts.rows, place, "right") - 1, 0])


class _Form:
    """What groups have in common whose records can be read as one."""

    def __init__(self, number: int, facts: Mapping[str, Any], columns: Mapping[str, PackedColumn]) -> None:
        self.facts = facts
        self.number = number
        self.names = tuple(columns)
        # (G, C, 3) of each column of each group: its address, the rows of every record, and where pointers to the rows
        # of each begin among those of all, -1 = it needs none.
        self.tables = _Grown(np.int64, len(columns), 3)
        self._kinds = [(one.values.dtype, one.values.shape[1:]) for one in columns.values()]
        # The columns whose rows can be left where they lie, by name.
        self.plain = {
            name: self.names.index(name) for name, kind in zip(columns, self._kinds) if _PLAIN.get(name) == kind
        }
        row_bytes = [kind.itemsize * math.prod(row) for kind, row in self._kinds]
        self._row_bytes = torch.tensor(row_bytes, dtype=torch.int64, device="cpu")
        self._roles = torch.tensor(_roles(columns, facts), dtype=torch.int64, device="cpu")
        self.update()

    def update(self) -> None:
        """Look at the tables anew, which a group was added to."""
        self.stored = StoredForm(self.number, self.tables.tensor, self._row_bytes, self._roles)

    def arrays(self, memory: Tensor, starts: list[int], totals: list[int]) -> dict[str, NDArray[Any]]:
        """Return the array of each column in memory, where they begin at some bytes."""
        held = memory.numpy()
        return {
            name: np.ndarray((total, *row), kind, held, start)
            for name, (kind, row), start, total in zip(self.names, self._kinds, starts, totals)
        }


def _roles(columns: Mapping[str, PackedColumn], facts: Mapping[str, Any]) -> list[Role]:
    """Return what the rows of each column belong to; ANY where records of these columns are no clouds, or have texts.

    Of such records :func:`joined_record` looks at the parts one by one.
    """
    ptr = columns.get("ptr")
    is_cloud = ptr is not None and ptr.values.dtype == np.int64 and ptr.values.ndim == 1 and "points" in columns
    if not (is_cloud and signals_are_arrays(columns, facts)):
        return [Role.ANY] * len(columns)
    named = {"ptr": Role.POINTERS, INFO: Role.TEXT, HISTORY: Role.TEXT}
    return [named.get(name, Role.PER_POINT if is_per_point(name) else Role.PER_CLOUD) for name in columns]


class _Grown:
    """An array that rows are added to."""

    def __init__(self, dtype: Any, *row: int) -> None:
        self._held: NDArray[Any] = np.empty((64, *row), dtype)
        self._size = 0
        self.tensor = torch.from_numpy(self._held[:0])  # of the same memory as `rows`

    @property
    def rows(self) -> NDArray[Any]:
        return self._held[: self._size]

    def add(self, rows: Any) -> int:
        """Add rows; return the number of the first."""
        first, size = self._size, self._size + len(rows)
        if size > len(self._held):
            grown = np.empty((max(size, 2 * len(self._held)), *self._held.shape[1:]), self._held.dtype)
            grown[:first] = self.rows
            self._held = grown
        self._held[first:size] = rows
        self._size = size
        self.tensor = torch.from_numpy(self.rows)
        return first
