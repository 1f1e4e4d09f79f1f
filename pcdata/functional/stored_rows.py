"""Records of stored groups: where the rows of many lie in mapped files, and one copy of all of them.

A group holds records one after another, column by column; groups of one form have the same columns. What is found is
one int64 table of C columns and R records, which the core writes in one pass and reads again when it copies:

    kind          OTHERS: a record is of another form, and nothing else was found; ROWS; or CLOUDS: each is one cloud
    pointers      the column of row pointers, -1 = none
    starts   C+1  the byte where each column begins once all are copied, and behind the last
    ends     CxR  the rows of a column up to each record and with it
    sources  CxR  the address of its rows
    sizes    CxR  their bytes
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.contracts.dispatch import inner
from pcdata.contracts.on_host import bounds_of

ALIGNED = 64  # bytes: a line of the processor's cache

OTHERS, ROWS, CLOUDS = range(3)  # kinds of what was found


class Role(IntEnum):
    """What the rows of a column belong to, where every record is one cloud."""

    ANY = 0
    PER_POINT = 1
    PER_CLOUD = 2
    POINTERS = 3
    TEXT = 4  # which is never empty


@dataclass(frozen=True)
class StoredForm:
    """Groups of one form, as int64 tensors."""

    number: int
    tables: Tensor  # (K, C, 3): a column's address; the rows of every record; its place in `pointers`, -1 = as many all
    row_bytes: Tensor  # (C,)
    roles: Tensor  # (C,)


@dataclass(frozen=True)
class StoredGroups:
    """All groups, whatever their forms, as int64 tensors."""

    firsts: Tensor  # (G,) the place of the first record of each
    which: Tensor  # (G, 2) its form, and its number among those of the form
    pointers: Tensor  # (P,) row pointers of columns, one table after another


class Found(NamedTuple):
    """The parts of the table."""

    kind: int
    pointers: int
    starts: NDArray[np.int64]  # (C+1,)
    ends: NDArray[np.int64]  # (C, R)
    sources: NDArray[np.int64]  # (C, R)
    sizes: NDArray[np.int64]  # (C, R)


def table_size(columns: int, records: int) -> int:
    """Return how many numbers the table has."""
    return 3 + columns + 3 * columns * records


def parts_of(table: Tensor, columns: int, records: int) -> Found:
    """Return the parts of a table; they share its memory."""
    numbers, size = table.numpy(), columns * records
    begin = 3 + columns
    ends, sources, sizes = (
        numbers[begin + part * size : begin + part * size + size].reshape(columns, records) for part in range(3)
    )
    return Found(int(numbers[0]), int(numbers[1]), numbers[2:begin], ends, sources, sizes)


@inner
def find_records(places: Tensor, groups: StoredGroups, form: StoredForm) -> Tensor:
    """Return the table of the records at R >= 1 places, (R,) int64, which are known to exist."""
    columns, records = len(form.roles), len(places)
    table = torch.zeros(table_size(columns, records), dtype=torch.int64, device="cpu")
    firsts, which, pointers = (one.numpy() for one in (groups.firsts, groups.which, groups.pointers))
    own = np.searchsorted(firsts, places.numpy(), "right") - 1
    if (which[own, 0] != form.number).any():
        return table
    numbers = places.numpy() - firsts[own]
    begins, counts, tables = np.moveaxis(form.tables.numpy()[which[own, 1]], 2, 0)
    first = counts * numbers[:, None]
    for record, column in zip(*np.nonzero(tables >= 0)):
        at = tables[record, column] + numbers[record]
        first[record, column], counts[record, column] = pointers[at], pointers[at + 1] - pointers[at]
    row_bytes, roles = form.row_bytes.numpy(), form.roles.tolist()
    found = parts_of(table, columns, records)
    found.ends[:] = counts.cumsum(axis=0).T
    found.sources[:] = (begins + first * row_bytes).T
    found.sizes[:] = (counts * row_bytes).T
    pointed = roles.index(Role.POINTERS) if Role.POINTERS in roles else -1
    is_clouds = pointed >= 0 and _are_clouds(roles, counts.T, found.sources[pointed])
    sizes = found.sizes.sum(axis=1)
    if is_clouds:
        sizes[pointed] = 8 * (records + 1)
    found.starts[1:] = (sizes + -sizes % ALIGNED).cumsum()
    table[0], table[1] = CLOUDS if is_clouds else ROWS, pointed
    return table


def _are_clouds(roles: list[int], counts: NDArray[np.int64], pointers: NDArray[np.int64]) -> bool:
    """Whether every record is one cloud: its row pointers are 0 and the rows of its columns."""
    if (counts[roles.index(Role.POINTERS)] != 2).any():
        return False
    ptr = np.array([[*(ctypes.c_int64 * 2).from_address(address)] for address in pointers.tolist()])
    fits = {
        Role.PER_POINT: lambda own: np.array_equal(own, ptr[:, 1]),
        Role.PER_CLOUD: lambda own: bool((own == 1).all()),
        Role.TEXT: lambda own: bool((own > 0).all()),
    }
    return not ptr[:, 0].any() and all(fits[Role(role)](own) for role, own in zip(roles, counts) if role in fits)


@inner
def gather_records(into: Tensor, form: StoredForm, table: Tensor) -> None:
    """Copy the rows of all that was found into (bytes,) uint8; of clouds, the row pointers become those of all."""
    columns = len(form.roles)
    found = parts_of(table, columns, (len(table) - 3 - columns) // (3 * columns))
    held, joined = into.numpy(), found.pointers if found.kind == CLOUDS else -1
    for column, (start, row) in enumerate(zip(found.starts.tolist(), form.row_bytes.tolist())):
        if column == joined:
            points = found.ends[form.roles.tolist().index(Role.PER_POINT)]
            held[start : start + 8 * (len(points) + 1)].view(np.int64)[:] = [0, *points]
            continue
        for end, source, size in zip(*(part[column].tolist() for part in (found.ends, found.sources, found.sizes))):
            if size:
                stop = start + end * row
                held[stop - size : stop] = (ctypes.c_uint8 * size).from_address(source)


@inner
def gather_kept(
    rooms: Mapping[str, Tensor],  # name -> (N, ...), without gaps, which is written over
    sources: Mapping[
        str, Tensor
    ],  # name -> (B,) int64, the address of each cloud's rows, in memory that somebody holds
    ptr: Tensor,  # (B+1,) int64
    kept: tuple[Tensor, Tensor]
    | None = None,  # a (N,) bool mask, and the (B+1,) row pointers of what stays; None = all
) -> dict[str, Tensor]:
    """Copy the rows that stay of every field, one after another; return them, in the memory of the rooms."""
    copied = {}
    for name, room in rooms.items():
        to, row_bytes, end = room.numpy().reshape(-1).view(np.uint8), room.nbytes // max(1, len(room)), 0
        for address, (start, stop) in zip(sources[name].tolist(), pairwise(bounds_of(ptr))):
            if stop == start:
                continue
            rows = np.array((ctypes.c_uint8 * ((stop - start) * row_bytes)).from_address(address))
            rows = rows.reshape(stop - start, row_bytes)
            rows = rows if kept is None else rows[kept[0][start:stop].numpy()]
            to[end : end + rows.size] = rows.reshape(-1)
            end += rows.size
        copied[name] = room[: len(room) if kept is None else int(kept[1][-1])]
    return copied
