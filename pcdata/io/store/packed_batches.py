"""Records of many packed files read as one: their rows are looked up all at once, and copied once."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.functional.rows import copy_blocks
from pcdata.io.store.cloud_record import DERIVED, Record, Room
from pcdata.io.store.joined_record import joined_record
from pcdata.io.store.packed_file import ALIGNED, PackedFile, PackedGroup
from pcdata.io.store.store import INFO
from pcdata.structures.read_later import StoredTexts

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
        form.varies |= bool(pointers)
        self._firsts.add([self._num_records])
        self._which.add([[form.number, place]])
        self._num_records += group.size

    def read(self, places: NDArray[np.int64], room: Room | None = None) -> Record | None:
        """Return the record of all clouds in a row; None where facts differ, or arrays in name, dtype or row."""
        groups = np.searchsorted(self._firsts.rows, places, "right") - 1
        which = self._which.rows[groups]
        numbers = which[:, 0]
        if (numbers != numbers[0]).any():
            return None
        form = list(self._forms.values())[int(numbers[0])]
        begins, first, counts = self._rows_of(form, which[:, 1], places - self._firsts.rows[groups])
        sizes = counts * form.row_bytes
        totals = sizes.sum(axis=0)
        starts = np.concatenate([np.zeros(1, np.int64), (totals + -totals % ALIGNED).cumsum()])
        memory = None if room is None else room(int(starts[-1]))
        if memory is None:
            memory = torch.empty(int(starts[-1]), dtype=torch.uint8, device="cpu")
        copy_blocks(memory, starts[:-1] + sizes.cumsum(axis=0) - sizes, begins + first * form.row_bytes, sizes)
        arrays = form.arrays(memory, starts, counts.sum(axis=0).tolist())
        rows = dict(zip(form.names, counts.T))
        texts = [StoredTexts(arrays.pop(name), rows.pop(name).cumsum()) for name in (INFO, HISTORY)]
        record = joined_record(arrays, rows, form.facts, *texts)
        return record if record is None else Record(record.arrays, record.info, form)

    def _rows_of(
        self, form: _Form, groups: NDArray[np.int64], records: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Return where the columns of each record's group begin, its first row and its number of rows: (R, C)."""
        tables = form.tables.rows[groups]
        begins, counts, pointers = tables[..., 0], tables[..., 1], tables[..., 2]
        first = counts * records[:, None]
        if form.varies:
            differ = pointers >= 0
            at = np.where(differ, pointers + records[:, None], 0)
            table = self._pointers.rows
            from_table = table[at]
            first = np.where(differ, from_table, first)
            counts = np.where(differ, table[at + 1] - from_table, counts)
        return begins, first, counts


class _Form:
    """What groups have in common whose records can be read as one."""

    def __init__(self, number: int, facts: Mapping[str, Any], columns: Mapping[str, Any]) -> None:
        self.number = number
        self.facts = facts
        self.names = tuple(columns)
        self.varies = False  # whether records of some group differ in the rows of a column
        # (G, C, 3) of each column of each group: its address, the rows of every record, and where pointers to the rows
        # of each begin among those of all, -1 = it needs none.
        self.tables = _Grown(np.int64, len(columns), 3)
        self._kinds = [(one.values.dtype, one.values.shape[1:]) for one in columns.values()]
        self.row_bytes = np.array([kind.itemsize * math.prod(row) for kind, row in self._kinds], dtype=np.int64)

    def arrays(self, memory: Tensor, starts: NDArray[np.int64], totals: list[int]) -> dict[str, NDArray[Any]]:
        """Return the array of each column in memory, where they begin at some bytes."""
        held = memory.numpy()
        return {
            name: np.ndarray((total, *row), kind, held, start)
            for name, (kind, row), start, total in zip(self.names, self._kinds, starts.tolist(), totals)
        }


class _Grown:
    """An array that rows are added to."""

    def __init__(self, dtype: Any, *row: int) -> None:
        self._held: NDArray[Any] = np.empty((64, *row), dtype)
        self._size = 0

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
        return first
