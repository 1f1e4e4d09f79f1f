"""Kernels of stored records: their rows are found in one pass, and copied in one."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

import pcdata.functional.stored_rows  # noqa: F401 - the functions must be registered before their kernels
from pcdata.contracts.dispatch import INNER, kernel
from pcdata.functional.stored_rows import StoredForm, StoredGroups, table_size
from pcdata.kernels.cpu.native import addresses, call, numbers, room


@kernel("find_records", "cpu")
def find_records(places: Tensor, groups: StoredGroups, form: StoredForm) -> Tensor:
    """Look every record up once."""
    columns, records = form.roles.shape[0], places.shape[0]
    table = room(table_size(columns, records), torch.int64)
    call(
        "pc_find_records",
        *(places, records, groups.firsts, groups.which, groups.firsts.shape[0], form.number, form.tables),
        *(groups.pointers, columns, form.row_bytes, form.roles, table),
    )
    return table


@kernel("gather_records", "cpu")
def gather_records(into: Tensor, form: StoredForm, table: Tensor) -> None:
    """Copy all in one call."""
    columns = form.roles.shape[0]
    records = (table.shape[0] - 3 - columns) // (3 * columns)
    call("pc_gather_records", records, columns, form.row_bytes, form.roles, table, into)


@kernel("gather_kept", "cpu")
def gather_kept(
    rooms: Mapping[str, Tensor],
    sources: Mapping[str, Tensor],
    ptr: Tensor,
    kept: tuple[Tensor, Tensor] | None = None,
) -> dict[str, Tensor]:
    """Copy cloud by cloud, all fields of each."""
    if kept is None:
        copied: dict[str, Tensor] = INNER["gather_kept"].reference(rooms, sources, ptr)
        return copied
    mask, kept_ptr = kept
    own = [*rooms.values()]
    call(
        "pc_gather_kept",
        *(ptr, ptr.shape[0] - 1, mask, kept_ptr, len(own), torch.stack([sources[name] for name in rooms])),
        *(numbers(room.nbytes // max(1, room.shape[0]) for room in own), addresses(own)),
    )
    count = int(kept_ptr[-1])
    return {name: room[:count] for name, room in rooms.items()}
