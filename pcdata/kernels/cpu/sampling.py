"""Sampling kernels: voxels, farthest points."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

import pcdata.functional.sampling  # noqa: F401 - the functions must be registered before their kernels
from pcdata.contracts.dispatch import INNER, OPERATIONS, kernel
from pcdata.contracts.on_host import counts_of
from pcdata.functional.rows import ptr_from_counts
from pcdata.functional.voxels import SIZE_TOLERANCE
from pcdata.kernels.cpu.native import answers, call, numbers, room

# The core numbers the rows of one cloud, and voxels, with 32 bits.
_MAX_ROWS = 2**31 - 1


@kernel("farthest_rows", "cpu")
def farthest_rows(points: Tensor, ptr: Tensor, counts: list[int]) -> Tensor:
    """Visit only the points that a pick can change."""
    width = points.shape[1]
    if not width or _too_long(ptr):
        rows: Tensor = INNER["farthest_rows"].reference(points, ptr, counts)
        return rows
    picks = room(sum(counts), torch.int64)
    arrays = points.contiguous(), ptr.contiguous(), len(counts)
    if width == 3:
        call("pc_farthest_points", *arrays, None, points.shape[0], numbers(counts), picks, None)
    else:
        call("pc_wide_farthest_points", *arrays, width, numbers(counts), picks)
    return _of_all_clouds(picks, ptr, counts)


@kernel("farthest_rows_within", "cpu")
def farthest_rows_within(points: Tensor, ptr: Tensor, within: Tensor, counts: list[int]) -> tuple[Tensor, Tensor]:
    """Gather the points within, and tell of the picks where they were."""
    if points.shape[0] > _MAX_ROWS:
        found: tuple[Tensor, Tensor] = INNER["farthest_rows_within"].reference(points, ptr, within, counts)
        return found
    rows, picks = room(sum(counts), torch.int64), room(sum(counts), torch.int64)
    arrays = points.contiguous(), ptr.contiguous(), len(counts), within.contiguous(), points.shape[0]
    call("pc_farthest_points", *arrays, numbers(counts), picks, rows)
    return rows, _of_all_clouds(picks, ptr, counts)


def _of_all_clouds(picks: Tensor, ptr: Tensor, counts: list[int]) -> Tensor:
    if len(counts) == 1:
        return picks
    wanted = torch.tensor(counts, dtype=torch.int64, device="cpu")
    return picks.add_(torch.repeat_interleave(ptr[:-1], wanted))


@kernel("voxel_means", "cpu")
def voxel_means(
    points: Tensor, ptr: Tensor, edges: Tensor, origin: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Number voxels in a hash table; sums are integers, so threads change nothing."""
    if _too_long(ptr):
        return _reference("voxel_means", points, ptr, edges, origin)
    # As many rows as there could be: those not written never become memory.
    points, ptr = points.contiguous(), ptr.contiguous()
    means, inverse, members = room(points.shape, points.dtype), *(room(points.shape[0], torch.int64) for _ in range(2))
    counts, spans_too_many = room(ptr.shape[0] - 1, torch.int64), answers()
    sizes = edges.expand(-1, 3).contiguous()
    corners = None if origin is None else origin.contiguous()
    arrays = points, ptr, ptr.shape[0] - 1, sizes, corners, means, inverse, members, counts, spans_too_many
    call("pc_voxel_downsample", *arrays)
    if spans_too_many[0]:
        return _reference("voxel_means", points, ptr, edges, origin)  # knows what to say
    means_ptr = ptr_from_counts(counts)
    number = int(means_ptr[-1])
    # Not clone(): see pcdata.contracts.tensors on torch's threads.
    means, members = (torch.from_numpy(values[:number].numpy().copy()) for values in (means, members))
    return means, means_ptr, inverse, members


@kernel("find_voxel_size", "cpu")
def find_voxel_size(points: Tensor, ptr: Tensor, *, num_points: int) -> Tensor:
    """Bisect like the reference: small clouds side by side, large ones with all threads."""
    sizes, possible = room(ptr.shape[0] - 1, torch.float64), answers()
    if not _too_long(ptr) and num_points <= _MAX_ROWS:
        call("pc_find_voxel_sizes", points, ptr, sizes.shape[0], num_points, SIZE_TOLERANCE, sizes, possible)
        if possible[0]:
            return sizes
    return _reference("find_voxel_size", points, ptr, num_points=num_points)  # knows what to say


def _too_long(ptr: Tensor) -> bool:
    return max(counts_of(ptr)) > _MAX_ROWS


def _reference(name: str, *args: Any, **kwargs: Any) -> Any:
    return (OPERATIONS if name in OPERATIONS else INNER)[name].reference(*args, **kwargs)
