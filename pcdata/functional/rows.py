"""Arithmetic on packed clouds: rows of many clouds one after another, cut by row pointers.

Cloud b of a batch is rows ``ptr[b]:ptr[b+1]``; any cloud may be empty. Rows may also be in groups that need not be
neighbors, such as the points of a voxel: ``group`` (N,) int64 names the group of each row, below ``num_groups``.
Reductions over groups ignore the order of the rows, except for the last bits of float64 sums; on the CPU those are
taken in row order.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from pcdata.contracts.checksums import checksums
from pcdata.contracts.dispatch import inner
from pcdata.contracts.host import all_finite
from pcdata.contracts.on_host import bounds_of, uploaded
from pcdata.geometry.rigid import from_rotation_translation

# Up to here a look at each cloud by itself costs less than running totals of all rows.
_FEW_CLOUDS = 64


def counts_from_ptr(ptr: Tensor) -> Tensor:
    """Return the (B,) number of rows of every cloud."""
    return ptr[1:] - ptr[:-1]


def ptr_from_counts(counts: Tensor | Iterable[int], device: torch.device | None = None) -> Tensor:
    """Return (B+1,) row pointers for (B,) counts."""
    if not isinstance(counts, Tensor):
        ends = torch.from_numpy(np.array([0, *accumulate(counts)], np.int64))
        return ends if device is None else uploaded(ends, device)
    counts = counts.to(dtype=torch.int64)
    ptr = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    return ptr if device is None or ptr.device.type != "cpu" else uploaded(ptr, device)


def cloud_of_rows(ptr: Tensor) -> Tensor:
    """Return (N,) int64: the cloud that each row belongs to."""
    counts = counts_from_ptr(ptr)
    clouds = torch.arange(len(counts), dtype=torch.int64, device=ptr.device)
    bounds = bounds_of(ptr)
    return torch.repeat_interleave(clouds, counts, output_size=bounds[-1] - bounds[0])


def ptr_after_mask(mask: Tensor, ptr: Tensor) -> Tensor:
    """Return the row pointers of ``rows[mask]`` for a (N,) bool mask."""
    if mask.device.type == "cpu" and ptr.shape[0] <= _FEW_CLOUDS:
        flags, ends = mask.numpy(), [0]
        for start, stop in pairwise(ptr.tolist()):
            ends.append(ends[-1] + int(np.count_nonzero(flags[start:stop])))
        return torch.tensor(ends, dtype=torch.int64, device="cpu")
    return ptr_from_counts(count_per_cloud(mask, ptr))


def count_per_cloud(mask: Tensor, ptr: Tensor) -> Tensor:
    """Return the (B,) number of true rows of every cloud for a (N,) bool mask."""
    if mask.device.type == "cpu" and len(ptr) <= _FEW_CLOUDS:
        flags = mask.numpy()
        counts = [np.count_nonzero(flags[start:stop]) for start, stop in pairwise(bounds_of(ptr))]
        return torch.tensor(counts, dtype=torch.int64, device="cpu")
    before = torch.cat([mask.new_zeros(1, dtype=torch.int64), mask.cumsum(0)])
    return counts_from_ptr(before[ptr])


def rows_of_mask(mask: Tensor, count: int) -> Tensor:
    """Return the (count,) int64 rows where a (N,) mask of so many true values is true; the host waits for nothing."""
    if mask.device.type == "cpu":
        return mask.nonzero().squeeze(1)
    ranks = torch.arange(1, count + 1, dtype=torch.int64, device=mask.device)
    return torch.searchsorted(mask.cumsum(0), ranks)


def picked_rows(mask: Tensor, ptr: Tensor) -> tuple[Tensor, Tensor]:
    """Return the rows where a (N,) mask is true, and their row pointers (B+1,); the host waits once."""
    after = ptr_after_mask(mask, ptr)
    return rows_of_mask(mask, bounds_of(after)[-1]), after


class KeptRows(NamedTuple):
    """What a decision leaves of the rows of packed clouds."""

    keep: Tensor  # (N,) bool
    ptr: Tensor  # (B+1,) int64: row pointers of the rows that stay
    sums: Tensor | None  # (B,) int64 that tell which stay: their checksums; None where the host would wait for them


@inner
def kept_rows(marks: Tensor, ptr: Tensor, *, gone: bool = False, within: Tensor | None = None) -> KeptRows:
    """Keep the rows whose mark, of a (N,) bool mask, is true; or with ``gone`` those whose mark is not.

    Of all but the rows ``within``, a (N,) bool mask too, nothing is kept or told: checksums are those of marks that
    only these rows have.
    """
    keep = ~marks if gone else marks
    told, told_ptr = keep, ptr
    if within is not None:
        keep, told, told_ptr = keep & within, keep[within], ptr_after_mask(within, ptr)
    sums = None
    if keep.device.type == "cpu":
        sums = torch.tensor(checksums(told, bounds_of(told_ptr)), dtype=torch.int64, device="cpu")
    return KeptRows(keep, ptr_after_mask(keep, ptr), sums)


@inner
def pick_rows(
    fields: Mapping[str, Tensor], rows: Tensor, *, in_place: bool = False, count: int | None = None
) -> dict[str, Tensor]:
    """Return ``field[rows]`` of every (N, ...) field, for (M,) int64 rows or a (N,) bool mask.

    Args:
        fields: by name.
        rows: which.
        in_place: the rows of a mask are moved to the beginning of their field's own memory, which is the result.
        count: how many rows of a mask are true, where the caller knows: then they are copied in one go.
    """
    index = torch.nonzero(rows).squeeze(1) if rows.dtype is torch.bool else rows
    if in_place:
        return {name: field[: len(index)].copy_(field[index]) for name, field in fields.items()}
    return {name: field[index] for name, field in fields.items()}


@inner
def join_rows(parts: Mapping[str, Sequence[Tensor]]) -> dict[str, Tensor]:
    """Put the parts of every field one after another."""
    return {name: torch.cat(list(values)) for name, values in parts.items()}


@inner
def pad_rows(parts: Mapping[str, Sequence[Tensor]], width: int, fillers: Mapping[str, int]) -> dict[str, Tensor]:
    """Put B parts of up to ``width`` rows of each field into (B, width, ...); the fillers are 0, or -1 for integers."""
    padded = {}
    for name, values in parts.items():
        shape = (len(values), width, *values[0].shape[1:])
        padded[name] = values[0].new_full(shape, fillers[name])
        for row, value in zip(padded[name], values):
            row[: len(value)] = value
    return padded


def first_per_cloud(mask: Tensor, ptr: Tensor) -> Tensor:
    """Return the (B,) first true row of every cloud for a (N,) bool mask; its first row where none is true."""
    if mask.device.type == "cpu" and len(ptr) <= _FEW_CLOUDS:
        flags = mask.numpy()
        first = [start + int(flags[start:stop].argmax()) for start, stop in pairwise(bounds_of(ptr))]
        return torch.tensor(first, dtype=torch.int64, device="cpu")
    rows = mask.nonzero().squeeze(1)
    place = torch.searchsorted(rows, ptr[:-1])
    found = rows[place.clamp(max=len(rows) - 1)] if len(rows) else ptr[:-1]
    return torch.where((place < len(rows)) & (found < ptr[1:]), found, ptr[:-1])


def segment_sum(values: Tensor, ptr: Tensor) -> Tensor:
    """Sum (N, ...) rows per cloud into (B, ...), in float64 for floats; an empty cloud sums to 0."""
    wide = values.double() if values.dtype.is_floating_point else values
    total = wide.new_zeros((len(ptr) - 1, *values.shape[1:]))
    return total.index_add_(0, cloud_of_rows(ptr), wide)


def segment_mean(values: Tensor, ptr: Tensor) -> Tensor:
    """Average (N, ...) rows per cloud into (B, ...) float64; an empty cloud averages to 0."""
    counts = counts_from_ptr(ptr).clamp(min=1).double()
    return segment_sum(values, ptr) / counts.reshape(-1, *[1] * (values.ndim - 1))


def segment_max(values: Tensor, ptr: Tensor) -> Tensor:
    """Take the maximum of (N, ...) values per cloud; an empty cloud gives the dtype's lowest value."""
    info = torch.finfo(values.dtype) if values.dtype.is_floating_point else torch.iinfo(values.dtype)
    return _segment_extreme(values, ptr, "amax", info.min)


def segment_min(values: Tensor, ptr: Tensor) -> Tensor:
    """Take the minimum of (N, ...) values per cloud; an empty cloud gives the dtype's highest value."""
    info = torch.finfo(values.dtype) if values.dtype.is_floating_point else torch.iinfo(values.dtype)
    return _segment_extreme(values, ptr, "amin", info.max)


def _segment_extreme(values: Tensor, ptr: Tensor, reduce: str, empty: float) -> Tensor:
    found = torch.full((len(ptr) - 1, *values.shape[1:]), empty, dtype=values.dtype, device=values.device)
    if len(ptr) <= _FEW_CLOUDS:  # each at the speed of memory
        for cloud, (start, stop) in enumerate(pairwise(bounds_of(ptr))):
            if stop > start:  # by index: autograd takes no change of rows that iteration gave
                found[cloud] = values[start:stop].amax(0) if reduce == "amax" else values[start:stop].amin(0)
        return found
    clouds = cloud_of_rows(ptr).reshape(-1, *[1] * (values.ndim - 1)).expand_as(values)
    return found.scatter_reduce_(0, clouds, values, reduce)


def group_count(group: Tensor, num_groups: int) -> Tensor:
    """Return the (G,) int64 number of rows in each group."""
    if group.device.type == "cpu":
        return torch.bincount(group, minlength=num_groups)
    return group.new_zeros(num_groups).index_add_(0, group, torch.ones_like(group))  # bincount waits for the maximum


def group_first(group: Tensor, num_groups: int) -> Tensor:
    """Return the (G,) int64 lowest row of each group; N for an empty one."""
    rows = torch.arange(len(group), dtype=torch.int64, device=group.device)
    return torch.full((num_groups,), len(group), dtype=torch.int64, device=group.device).scatter_reduce_(
        0, group, rows, "amin"
    )


def group_sum(values: Tensor, group: Tensor, num_groups: int) -> Tensor:
    """Sum (N, C) rows into (G, C), in the dtype of the values; an empty group sums to 0."""
    total = values.new_zeros((num_groups, values.shape[1]))
    return total.scatter_add_(0, group[:, None].expand_as(values), values)


@inner
def transform_points(points: Tensor, ptr: Tensor, matrix: Tensor) -> Tensor:
    """Map (N,3) points by one affine (B,4,4) matrix per cloud, computed in float64, returned in the points' dtype."""
    matrix = matrix.double()
    # One number per entry for a single cloud, one per row for a batch: the same sums either way, bit for bit.
    cloud: int | Tensor = 0 if len(ptr) == 2 else cloud_of_rows(ptr)
    x, y, z = points.double().unbind(1)
    moved = [
        ((x * matrix[cloud, axis, 0] + y * matrix[cloud, axis, 1]) + z * matrix[cloud, axis, 2])
        + matrix[cloud, axis, 3]
        for axis in range(3)
    ]
    return torch.stack(moved, dim=1).to(points.dtype)


@inner
def transform_directions(directions: Tensor, ptr: Tensor, matrix: Tensor) -> Tensor:
    """Map (N,3) surface normals: inverse transpose of the linear part, then unit length; zero vectors stay zero."""
    linear = torch.linalg.inv(matrix[:, :3, :3].double()).mT
    moved = transform_points(directions.double(), ptr, from_rotation_translation(linear, linear.new_zeros(3)))
    x, y, z = moved.unbind(1)
    length = ((x * x + y * y) + z * z).clamp(min=1e-24).sqrt()  # the root of 0 has no gradient
    return (moved / length[:, None]).to(directions.dtype)


@inner
def inside_box(points: Tensor, lower: Sequence[float], upper: Sequence[float]) -> Tensor | None:
    """Return a (N,) bool mask of the (N, 3) points with lower <= point <= upper; None if one is NaN or infinite."""
    if not all_finite(points):  # a comparison would leave them out without a word
        return None
    low, high = (
        uploaded(torch.tensor(corner, dtype=points.dtype, device="cpu"), points.device) for corner in (lower, upper)
    )
    return ((points >= low) & (points <= high)).all(dim=1)
