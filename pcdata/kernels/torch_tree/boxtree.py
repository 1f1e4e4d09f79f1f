"""An implicit tree of boxes over points in Morton order: the structure behind every exact neighbor search.

Each cloud is sorted along a Morton (Z-order) curve, every 16 consecutive points form a leaf, every 8 consecutive nodes
a parent, up to one root per cloud. There are no tuning parameters that depend on the data, so dense and sparse regions
in one cloud are served alike.

Source: Morton, A computer oriented geodetic data base, IBM 1966; the implicit hierarchy follows Lauterbach et al.,
Fast BVH construction on GPUs, 2009.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pcdata.contracts.on_host import counts_of, on_host
from pcdata.functional.nearest import sum_of_squares
from pcdata.functional.rows import cloud_of_rows, counts_from_ptr, group_count, picked_rows, ptr_from_counts

LEAF_SIZE = 16
FAN_OUT = 8
_BITS = 21  # per axis, three axes fill 63 bits


@dataclass(frozen=True)
class _Groups:
    """Consecutive rows of a ragged batch cut into groups that never cross a cloud; the last of a cloud may be short."""

    ptr: Tensor  # (B+1,) int64, the groups of every cloud
    first: Tensor  # (M,) int64, first row of each group
    count: Tensor  # (M,) int64, rows in it, 1 to size
    size: int

    @classmethod
    def of(cls, ptr: Tensor, size: int) -> _Groups:
        """Cut (B+1,) row pointers into groups of at most ``size`` rows."""
        counts = counts_from_ptr(ptr)
        group_ptr = ptr_from_counts((counts_from_ptr(on_host(ptr)) + size - 1) // size, ptr.device)
        cloud = cloud_of_rows(group_ptr)
        rank = torch.arange(len(cloud), dtype=torch.int64, device=ptr.device) - group_ptr[cloud]
        return cls(group_ptr, ptr[cloud] + rank * size, (counts[cloud] - rank * size).clamp(max=size), size)

    def table(self) -> tuple[Tensor, Tensor]:
        """Return (M, size) rows and the (M, size) mask of real slots; the others repeat the group's last row."""
        slot = torch.arange(self.size, dtype=torch.int64, device=self.first.device)
        return self.first[:, None] + torch.minimum(slot, self.count[:, None] - 1), slot < self.count[:, None]


@dataclass(frozen=True)
class _Level:
    """The boxes of one level; the children of box i are rows first[i] : first[i]+count[i] of the level below."""

    groups: _Groups
    low: Tensor  # (M, 3) float32
    high: Tensor  # (M, 3) float32


@dataclass(frozen=True)
class Leaves:
    """Points in Morton order, 16 to a row; the empty slots of a short leaf repeat its last point."""

    points: Tensor  # (L, 16, 3) float32
    row: Tensor  # (L, 16) int64, row in the caller's tensor
    real: Tensor  # (L, 16) bool, False for a repeated slot
    level: _Level

    @classmethod
    def of(cls, points: Tensor, ptr: Tensor, order: Tensor) -> Leaves:
        """Cut the rows ``points[order]``, whose clouds are given by ``ptr``, into leaves."""
        groups = _Groups.of(ptr, LEAF_SIZE)
        slots, real = groups.table()
        row = order[slots]
        members = points[row]
        return cls(members, row, real, _Level(groups, members.amin(1), members.amax(1)))

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class BoxTree:
    """Leaves and the levels of boxes above them, bottom first."""

    leaves: Leaves
    levels: list[_Level]
    # (3, L+1, 16) coordinates, infinity in empty slots and in the extra last row: infinite distances need no mask.
    coordinates: Tensor
    row: Tensor  # (L+1, 16) int64, N in empty slots: sorts after every real point
    num_points: int
    kept: Tensor  # (N,) bool in Morton order, False for a dropped duplicate
    ptr: Tensor  # (B+1,) int64, the kept points of every cloud

    @classmethod
    def build(cls, points: Tensor, ptr: Tensor, order: Tensor, *, max_copies: int) -> BoxTree:
        """Build the tree of (N,3) points, given their rows in Morton order.

        Of points with equal coordinates only the ``max_copies`` lowest rows are kept: under the order (distance, row)
        no further copy can be among the nearest ``max_copies``, and thousands of equal points (zeros left by missing
        depth) would otherwise cost quadratic time.
        """
        kept = _first_copies(points[order], ptr, max_copies)
        rows, ptr = picked_rows(kept, ptr)
        order = order[rows]
        leaves = Leaves.of(points, ptr, order)
        levels = [leaves.level]
        while max(counts_of(levels[-1].groups.ptr)) > 1:
            levels.append(_parents(levels[-1]))
        filled = torch.where(leaves.real[..., None], leaves.points, torch.inf)
        coordinates = torch.cat([filled, filled.new_full((1, LEAF_SIZE, 3), torch.inf)]).permute(2, 0, 1).contiguous()
        row = torch.where(leaves.real, leaves.row, len(points))
        row = torch.cat([row, row.new_full((1, LEAF_SIZE), len(points))])
        return cls(leaves, levels, coordinates, row, len(points), kept, ptr)

    @property
    def leaf_ptr(self) -> Tensor:
        """(B+1,) int64: the leaves of every cloud."""
        return self.leaves.level.groups.ptr


def box_gap(low: Tensor, high: Tensor, other_low: Tensor, other_high: Tensor) -> Tensor:
    """Return the squared distance between (..., 3) boxes; a point is a box with low = high.

    Rounding is monotone and the operations are those of the point distance in the same order, so the result never
    exceeds the computed distance of any two points in the boxes: pruning by it needs no tolerance.
    """
    return sum_of_squares(torch.maximum(low - other_high, other_low - high).clamp_(min=0))


def expand_ranges(first: Tensor, count: Tensor, owner: Tensor) -> tuple[Tensor, Tensor]:
    """Replace each range of rows by one (owner, row) pair per row, in order."""
    total = torch.cumsum(count, 0)
    rows = torch.arange(len(first), dtype=torch.int64, device=first.device)
    source = torch.repeat_interleave(rows, count, output_size=int(total[-1]) if len(total) else 0)
    rank = torch.arange(len(source), dtype=torch.int64, device=first.device) - (total - count)[source]
    return owner[source], first[source] + rank


def spatial_order(points: Tensor, cloud: Tensor, num_clouds: int) -> Tensor:
    """Return (N,) int64 rows that put (N,3) points in order of (N,) cloud, then Morton code; equal ones stay in order.

    A run of more than a leaf of equal codes that are not equal points is coded again in its own cube, so one stray
    point a kilometre away does not blur the order of the rest.
    """
    segment, order = torch.sort(cloud, stable=True)
    place = torch.arange(len(points), dtype=torch.int64, device=points.device)
    num_segments = num_clouds  # some may be empty
    while len(place):
        code = _morton_code(points[order[place]], segment, num_segments)
        code, by_code = torch.sort(code, stable=True)
        if num_segments > 1:
            by_segment = torch.argsort(segment[by_code], stable=True)
            code, by_code = code[by_segment], by_code[by_segment]
        order[place] = order[place][by_code]
        changes = (code[1:] != code[:-1]) | (segment[1:] != segment[:-1])
        run = torch.cat([changes.new_zeros(1), changes]).cumsum(0)
        crowded = (group_count(run, len(run))[run] > LEAF_SIZE).nonzero().squeeze(1)
        place, segment = place[crowded], run[crowded]
        if len(place):
            changes = segment[1:] != segment[:-1]
            segment = torch.cat([changes.new_zeros(1), changes]).cumsum(0)
            num_segments = int(segment[-1]) + 1
            low, high = _bounds(points[order[place]], segment, num_segments)
            spread = (low != high).any(1)[segment].nonzero().squeeze(1)
            place, segment = place[spread], segment[spread]
    return order


def _morton_code(points: Tensor, segment: Tensor, num_segments: int) -> Tensor:
    low, high = _bounds(points.double(), segment, num_segments)
    extent = (high - low).amax(1, keepdim=True)
    scale = torch.where(extent > 0, (2**_BITS - 1) / extent, 0.0)
    cell = ((points - low[segment]) * scale[segment]).long()
    return _spread_bits(cell[:, 0]) << 2 | _spread_bits(cell[:, 1]) << 1 | _spread_bits(cell[:, 2])


def _spread_bits(value: Tensor) -> Tensor:
    """Put two zero bits between the 21 bits of each value."""
    value = (value | value << 32) & 0x1F00000000FFFF
    value = (value | value << 16) & 0x1F0000FF0000FF
    value = (value | value << 8) & 0x100F00F00F00F00F
    value = (value | value << 4) & 0x10C30C30C30C30C3
    return (value | value << 2) & 0x1249249249249249


def _bounds(points: Tensor, segment: Tensor, num_segments: int) -> tuple[Tensor, Tensor]:
    """Return the (S,3) lowest and highest corner of every segment; of an empty one they mean nothing."""
    if num_segments == 1:
        return points.amin(0, keepdim=True), points.amax(0, keepdim=True)
    index = segment[:, None].expand(-1, 3)
    low = points.new_full((num_segments, 3), torch.inf).scatter_reduce_(0, index, points, "amin")
    high = points.new_full((num_segments, 3), -torch.inf).scatter_reduce_(0, index, points, "amax")
    return low, high


def _first_copies(ordered: Tensor, ptr: Tensor, max_copies: int) -> Tensor:
    """Return a (N,) mask without the copies after the first ``max_copies`` in a cloud's runs of equal (N,3) points."""
    place = torch.arange(len(ordered), dtype=torch.int64, device=ordered.device)
    if len(place) == 0:
        return place.bool()
    begins = torch.ones(len(ordered), dtype=torch.bool, device=ordered.device)
    begins[1:] = (ordered[1:] != ordered[:-1]).any(1)
    begins[ptr[:-1].clamp(max=len(ordered) - 1)] = True
    run_start = torch.where(begins, place, 0).cummax(0).values
    return place - run_start < max_copies


def _parents(below: _Level) -> _Level:
    groups = _Groups.of(below.groups.ptr, FAN_OUT)
    children, _ = groups.table()
    return _Level(groups, below.low[children].amin(1), below.high[children].amax(1))
