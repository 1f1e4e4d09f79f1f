"""Row kernels: picking rows of many fields at once, moving points, cutting out a box.

Clouds of any size come here, also tiny ones, and some of them on the way to an error that the reference words best: it
takes over whatever a kernel does not cover.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

import pcdata.geometry.rigid  # noqa: F401 - the functions must be registered before their kernels
from pcdata.contracts.dispatch import INNER, kernel
from pcdata.functional.rows import KeptRows
from pcdata.kernels.cpu.native import Numbers, addresses, answers, call, numbers, room, room_for

_MANY_ROWS = 300_000  # of all fields: some megabytes, which are worth a look at every part


@kernel("kept_rows", "cpu")
def kept_rows(marks: Tensor, ptr: Tensor, *, gone: bool = False, within: Tensor | None = None) -> KeptRows:
    """Turn marks, count them and sum them up in one look."""
    clouds = ptr.shape[0] - 1
    keep, kept_ptr, sums = room(marks.shape, torch.bool), room(clouds + 1, torch.int64), room(clouds, torch.int64)
    others = None if within is None else within.contiguous()
    call("pc_kept_rows", marks.contiguous(), gone, others, ptr.contiguous(), clouds, keep, kept_ptr, sums)
    return KeptRows(keep, kept_ptr, sums)


@kernel("pick_rows", "cpu")
def pick_rows(
    fields: Mapping[str, Tensor], rows: Tensor, *, in_place: bool = False, count: int | None = None
) -> dict[str, Tensor]:
    """Copy the rows of all fields piece by piece."""
    sources = list(fields.values())
    num_rows = len(sources[0]) if sources and sources[0].ndim else 0
    if num_rows == 0 or rows.ndim != 1 or not _are_plain(sources, num_rows):
        return _reference("pick_rows", fields, rows, in_place=in_place)
    if rows.dtype is torch.bool and rows.shape[0] == num_rows:
        if not in_place:
            return dict(zip(fields, _keep_rows(sources, rows.contiguous(), count)))
        if all(source.is_contiguous() for source in sources):
            return dict(zip(fields, _keep_rows_in_place(sources, rows.contiguous())))
    elif rows.dtype is torch.int64 and not in_place:
        picked = _take_rows(sources, rows.contiguous())
        if picked is not None:
            return dict(zip(fields, picked))
    return _reference("pick_rows", fields, rows, in_place=in_place)


def _keep_rows(fields: Sequence[Tensor], mask: Tensor, count: int | None) -> list[Tensor]:
    """Return the rows of a mask; a count that turns out to be wrong does no harm."""
    kept, rows = answers(), mask.shape[0]
    if count is None:
        call("pc_keep_rows", mask, rows, -1, 0, numbers(()), numbers(()), numbers(()), kept)
        count = kept[0]
    sources, picked, sizes = _sources_and_picked(fields, count)
    call("pc_keep_rows", mask, rows, count, len(fields), addresses(sources), sizes, addresses(picked), kept)
    return picked if kept[0] == count else _keep_rows(fields, mask, kept[0])


def _keep_rows_in_place(fields: Sequence[Tensor], mask: Tensor) -> list[Tensor]:
    kept, where, sizes = answers(), addresses(fields), numbers(map(_row_bytes, fields))
    call("pc_keep_rows", mask, mask.shape[0], mask.shape[0], len(fields), where, sizes, where, kept)
    return [field[: kept[0]] for field in fields]


def _take_rows(fields: Sequence[Tensor], index: Tensor) -> list[Tensor] | None:
    """Return the rows of all fields; None if an index is negative, which counts from the end, or out of range."""
    sources, picked, sizes = _sources_and_picked(fields, index.shape[0])
    possible = answers()
    of_all = len(fields), addresses(sources), sizes, addresses(picked)
    call("pc_take_rows", index, index.shape[0], len(fields[0]), *of_all, possible)
    return picked if possible[0] else None


def _sources_and_picked(fields: Sequence[Tensor], count: int) -> tuple[list[Tensor], list[Tensor], Numbers]:
    """Return the fields without gaps, room for ``count`` rows of each, and the bytes of a row of each."""
    sources = [field.contiguous() for field in fields]
    picked = room_for(*[((count, *field.shape[1:]), field.dtype) for field in fields])
    return sources, picked, numbers(map(_row_bytes, sources))


def _row_bytes(field: Tensor) -> int:
    return field.nbytes // field.shape[0]


def _are_plain(fields: Sequence[Tensor], num_rows: int) -> bool:
    """Whether rows are their bytes, and so many in every field."""
    for field in fields:
        strided = field.layout is torch.strided and field.is_cpu and field.ndim > 0
        if not strided or field.shape[0] != num_rows or field.is_conj() or field.is_neg():
            return False
    return True


@kernel("join_rows", "cpu")
def join_rows(parts: Mapping[str, Sequence[Tensor]]) -> dict[str, Tensor]:
    """Copy the parts of all fields, part by part; torch is as good at a few."""
    rows = sum(len(part) for field in parts.values() for part in field)
    counts = _counts_of_equal_parts(parts) if rows > _MANY_ROWS else None
    if counts is None:
        return _reference("join_rows", parts)
    return _placed(parts, counts, [0, *itertools.accumulate(counts)], dict.fromkeys(parts, 0))


@kernel("pad_rows", "cpu")
def pad_rows(parts: Mapping[str, Sequence[Tensor]], width: int, fillers: Mapping[str, int]) -> dict[str, Tensor]:
    """Copy and fill the parts of all fields, part by part."""
    counts = _counts_of_equal_parts(parts)
    if counts is None or max(counts) > width:
        return _reference("pad_rows", parts, width, fillers)
    placed = _placed(parts, counts, [width * part for part in range(len(counts) + 1)], fillers)
    return {name: block.reshape(len(counts), width, *block.shape[1:]) for name, block in placed.items()}


def _counts_of_equal_parts(parts: Mapping[str, Sequence[Tensor]]) -> list[int] | None:
    """Return the rows of each part; None where fields differ in them, or parts in what a row is."""
    fields = list(parts.values())
    if not fields or not fields[0]:
        return None
    counts = [len(part) if part.ndim else -1 for part in fields[0]]
    for field in fields:
        kind = field[0].dtype, field[0].shape[1:]
        if len(field) != len(counts):
            return None
        for part, count in zip(field, counts):
            if part.ndim == 0 or (part.dtype, part.shape[1:]) != kind or not _are_plain((part,), count):
                return None
    return counts


def _placed(
    parts: Mapping[str, Sequence[Tensor]], counts: list[int], starts: list[int], fillers: Mapping[str, int]
) -> dict[str, Tensor]:
    """Return one block per field with every part where it starts; the rest is padding."""
    firsts = [field[0] for field in parts.values()]
    blocks = room_for(*(((starts[-1], *first.shape[1:]), first.dtype) for first in firsts))
    sources = [part.contiguous() for field in parts.values() for part in field]
    row_bytes = [math.prod(first.shape[1:]) * first.element_size() for first in firsts]
    filling = [fillers[name] & 0xFF for name in parts]  # 0 and -1 are the numbers whose bytes are all alike
    call(
        "pc_place_rows",
        *(len(counts), numbers(counts), numbers(starts), len(firsts), addresses(sources)),
        *(numbers(row_bytes), numbers(filling), addresses(blocks)),
    )
    return dict(zip(parts, blocks))


@kernel("transform_points", "cpu")
def transform_points(points: Tensor, ptr: Tensor, matrix: Tensor) -> Tensor:
    """Move every point once, through registers."""
    if not _covers(points, ptr) or matrix.shape != (ptr.shape[0] - 1, 4, 4):
        return _reference("transform_points", points, ptr, matrix)
    (moved,) = room_for((points.shape, points.dtype))
    call("pc_transform_points", points.contiguous(), ptr.contiguous(), ptr.shape[0] - 1, _wide(matrix), moved)
    return moved


@kernel("transform_directions", "cpu")
def transform_directions(directions: Tensor, ptr: Tensor, matrix: Tensor) -> Tensor:
    """Turn every direction once, through registers."""
    if not _covers(directions, ptr) or matrix.shape != (ptr.shape[0] - 1, 4, 4):
        return _reference("transform_directions", directions, ptr, matrix)
    (turned,) = room_for((directions.shape, directions.dtype))
    linear = torch.linalg.inv(_wide(matrix)[:, :3, :3]).mT.contiguous()
    call("pc_transform_directions", directions.contiguous(), ptr.contiguous(), ptr.shape[0] - 1, linear, turned)
    return turned


def _covers(points: Tensor, ptr: Tensor) -> bool:
    """Whether these are float32 points that the row pointers cut completely."""
    fits = points.dtype is torch.float32 and points.shape[1:] == (3,) and ptr.dtype is torch.int64 and ptr.shape[0] > 1
    return fits and int(ptr[0]) == 0 and int(ptr[-1]) == points.shape[0]


def _wide(matrix: Tensor) -> Tensor:
    return matrix.double().contiguous()


@kernel("inside_box", "cpu")
def inside_box(points: Tensor, lower: Sequence[float], upper: Sequence[float]) -> Tensor | None:
    """Look at every point once."""
    if points.dtype is not torch.float32:
        return _reference("inside_box", points, lower, upper)
    inside, finite = room(points.shape[0], torch.bool), answers()
    corners = points.new_tensor(lower), points.new_tensor(upper)
    call("pc_inside_box", points.contiguous(), points.shape[0], *corners, inside, finite)
    return inside if finite[0] else None


def _reference(function: str, *args: Any, **options: Any) -> Any:
    return INNER[function].reference(*args, **options)
