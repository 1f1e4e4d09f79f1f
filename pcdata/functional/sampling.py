"""Choosing a fixed number of points: far apart, or at random."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner, op
from pcdata.contracts.numbers import checked_counts, checked_fraction, counts_per_cloud, require_rows
from pcdata.contracts.on_host import bounds_of, counts_of, on_host, uploaded
from pcdata.contracts.operators import Traced
from pcdata.errors import ConfigError, OutOfRangeError, ShapeError
from pcdata.functional.neighbors import knn
from pcdata.functional.noise import random_order, random_with_repeats
from pcdata.functional.rows import cloud_of_rows, counts_from_ptr, ptr_from_counts, segment_sum
from pcdata.rng import words

# Points per tile in the search for the farthest one; near the square root of a large cloud.
_TILE = 1024


@inner
def farthest_rows(points: Tensor, ptr: Tensor, counts: list[int], *, backend: str = "auto") -> Tensor:
    """Return (M,) int64 rows: ``counts[b]`` of each cloud of (N, D) points, each the farthest from those before it.

    Clouds of about one size are sampled side by side.
    """
    sizes = counts_of(ptr)
    picked = torch.empty(sum(counts), dtype=torch.int64, device=points.device)
    bounds = bounds_of(ptr)
    picked_ptr = ptr_from_counts(counts).tolist()
    for length in sorted({size.bit_length() for size in sizes}):
        clouds = [b for b, size in enumerate(sizes) if size.bit_length() == length and counts[b]]
        if not clouds:
            continue
        most = max(counts[b] for b in clouds)
        begin, end = (torch.tensor([bounds[b + k] for b in clouds], dtype=torch.int64, device="cpu") for k in (0, 1))
        rows = _farthest_side_by_side(points, begin, end, most)
        for b, own in zip(clouds, rows):
            picked[picked_ptr[b] : picked_ptr[b + 1]] = own[: counts[b]]
    return picked


@inner
def farthest_rows_within(
    points: Tensor,  # (N, 3) float32, all finite
    ptr: Tensor,  # (B+1,) of the rows within
    within: Tensor,  # (N,) bool
    counts: list[int],
    *,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:  # (M,) int64 rows of points, and the same rows counted among those within
    """Pick rows as :func:`farthest_rows` does, where the points ``within`` are all that there are."""
    place = farthest_rows(points[within], ptr, counts, backend=backend)
    return within.nonzero().squeeze(1)[place], place


def checked_ratio(where: str, name: str, arguments: Mapping[str, Any]) -> list[int]:
    """Require a number above 0 and at most 1; bodies get the counts, ceil(ratio * n) in float32 as torch-cluster."""
    ratio = torch.tensor(checked_fraction(where, name, arguments), dtype=torch.float32, device="cpu")
    return (counts_from_ptr(on_host(arguments["ptr"])).float() * ratio).ceil().long().tolist()


def _wanted_counts(where: str, num_samples: Any, ratio: Any) -> list[int]:
    if (num_samples is None) == (ratio is None):
        raise ConfigError(f"{where}: give either num_samples, points per cloud, or ratio, a part of each cloud")
    counts: list[int] = ratio if num_samples is None else num_samples
    return counts


@op(
    points="N D",
    ptr="ptr N B",
    start="B : int64",
    seeds="B : int64",
    labels="N : int64",
    num_samples=checked_counts,
    ratio=checked_ratio,
    steps=(farthest_rows,),
    gradient=False,
    traced=Traced(
        "Tensor points, Tensor? ptr, int num_samples, Tensor? start, Tensor? seeds",
        "Tensor index, Tensor picked_ptr",
        lambda points, ptr, num_samples, **_: (
            points.new_empty((1 if ptr is None else ptr.shape[0] - 1) * num_samples, dtype=torch.int64),
            points.new_empty(2 if ptr is None else ptr.shape[0], dtype=torch.int64),
        ),
    ),
)
def farthest_point_sample(
    points: Tensor,  # (N, D) float32
    ptr: Tensor | None = None,  # (B+1,)
    *,
    num_samples: int | Sequence[int] | Tensor | None = None,
    ratio: float | None = None,
    start: Tensor | None = None,  # (B,) int64
    seeds: Tensor | None = None,  # (B,) int64
    labels: Tensor | None = None,  # (N,) int64
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:  # index (M,) int64 rows of points, ptr (B+1,)
    """Pick points one by one, each the farthest from those already picked, starting at each cloud's first point.

    Exact, in picking order, and always distinct rows: repeats of a point are taken only when nothing else is left,
    lowest row first. Ties go to the lowest row. Squared distance is ((dx*dx) + (dy*dy)) + (dz*dz) in float32, and so
    on for more than three columns: coordinates beside weighted colors or features spread the samples over both.

    With ``labels`` every label of a cloud gets the same number of samples, as far as it has so many points; what is
    left over goes to the others, one each, the lowest label first. Each label is sampled by itself, and the samples of
    a cloud take turns by label. (-1 is a label like any other.)

    Args:
        points: the clouds, in any unit of length.
        ptr: row pointers.
        num_samples: one count for every cloud, or one per cloud (B,).
        ratio: part of every cloud instead of a count: ceil(ratio * n) points, computed in float32.
        start: row within its cloud where each begins, 0 = its first; among labels, its own label begins there.
        seeds: instead of start: where a cloud begins is drawn from its own seed, the same alone or in a batch.
        labels: label of each point.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        TooFewPointsError: a cloud has fewer points than asked for.
        ConfigError: both or none of num_samples and ratio, or both start and seeds.
        OutOfRangeError: a start that its cloud does not have.

    Source: Eldar et al., The Farthest Point Strategy for Progressive Image Sampling, IEEE TIP 6(9), 1997.
    """
    assert ptr is not None  # @op fills it
    counts = _wanted_counts("farthest_point_sample", num_samples, ratio)
    order = _rows_from_start("farthest_point_sample", ptr, start, seeds)
    if labels is None:
        given = points if order is None else points[order]
        picked = farthest_rows(given, ptr, counts, backend=backend)
        return picked if order is None else order[picked], ptr_from_counts(counts, device=points.device)
    if order is None:
        order = torch.arange(len(points), dtype=torch.int64, device=points.device)
    order = order[labels[order].argsort(stable=True)]
    order = order[cloud_of_rows(ptr)[order].argsort(stable=True)]
    owner = cloud_of_rows(ptr)
    is_first = torch.ones_like(order, dtype=torch.bool)  # of its label
    is_first[1:] = (labels[order].diff() != 0) | (owner[order].diff() != 0)
    first = is_first.nonzero().squeeze(1)
    sizes = torch.diff(first, append=torch.full((1,), len(order), dtype=first.dtype, device=first.device))
    wanted = uploaded(torch.tensor(counts, dtype=torch.int64, device="cpu"), ptr.device)
    shares = _equal_shares(sizes, owner[order[first]], wanted)
    picked = order[farthest_rows(points[order], ptr_from_counts(sizes), shares.tolist(), backend=backend)]
    turn = (
        torch.arange(len(picked), dtype=torch.int64, device=ptr.device)
        - ptr_from_counts(shares)[cloud_of_rows(ptr_from_counts(shares))]
    )
    picked = picked[turn.argsort(stable=True)]
    return picked[owner[picked].argsort(stable=True)], ptr_from_counts(counts, device=points.device)


@op(
    points="N D",
    ptr="ptr N B",
    start="B : int64",
    seeds="B : int64",
    num_samples=checked_counts,
    ratio=checked_ratio,
    steps=(farthest_rows,),
    gradient=False,
)
def farthest_point_groups(
    points: Tensor,  # (N, D) float32
    ptr: Tensor | None = None,  # (B+1,)
    *,
    num_samples: int | Sequence[int] | Tensor | None = None,
    ratio: float | None = None,
    start: Tensor | None = None,  # (B,) int64
    seeds: Tensor | None = None,  # (B,) int64
    backend: str = "auto",
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # index (M,) int64, ptr (B+1,), group (N,) int64, distance (N,) float32
    """Sample as :func:`farthest_point_sample` does, and assign every point to the sample nearest to it.

    ``group[i]`` is the place in ``index`` of point i's sample, ``distance[i]`` how far that is: the covering of each
    cloud. Of samples equally near the one picked first counts. A cloud of which no sample is taken has group M and
    distance infinity.

    Args:
        points: the clouds, in any unit of length.
        ptr: row pointers.
        num_samples: as there.
        ratio: as there.
        start: as there.
        seeds: as there.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        TooFewPointsError, ConfigError, OutOfRangeError: as there.
    """
    assert ptr is not None  # @op fills it
    where = "farthest_point_groups"
    counts = _wanted_counts(where, num_samples, ratio)
    order = _rows_from_start(where, ptr, start, seeds)
    picked = farthest_rows(points if order is None else points[order], ptr, counts, backend=backend)
    picked = picked if order is None else order[picked]
    picked_ptr = ptr_from_counts(counts, device=points.device)
    search = "torch" if backend == "torch" else "auto"
    group, distance = knn(points[picked], picked_ptr, k=1, queries=points, queries_ptr=ptr, backend=search)
    return picked, picked_ptr, group[:, 0], distance[:, 0]


def random_sample_index(
    ptr: Tensor,  # (B+1,)
    num_samples: int | Sequence[int] | Tensor,
    seeds: Tensor,  # (B,) int64, one per cloud
    *,
    replace: bool = False,
) -> tuple[Tensor, Tensor]:  # index (M,) int64 rows, ptr (B+1,)
    """Pick rows of each cloud uniformly at random, in random order, without repeats unless ``replace``.

    Without replacement it is the start of one permutation per cloud, so more samples extend fewer. Drawn on the CPU
    from each cloud's own seed: the same rows alone or in a batch, and on any device.

    Raises:
        TooFewPointsError: a cloud has fewer rows than asked for (with ``replace``: none at all).
        ShapeError: the number of seeds or counts is not the number of clouds.
    """
    wanted = counts_per_cloud("random_sample_index", num_samples, ptr)
    require_rows("random_sample_index", [min(k, 1) for k in wanted] if replace else wanted, ptr)
    if len(seeds) != len(wanted):
        raise ShapeError(f"random_sample_index: {len(seeds)} seeds were given for {len(wanted)} clouds")
    counts, number = on_host(counts_from_ptr(ptr)), torch.tensor(wanted, dtype=torch.int64, device="cpu")
    draw = random_with_repeats if replace else random_order
    rows = draw(counts, number, seeds.to(device="cpu", dtype=torch.int64))
    return uploaded(rows, ptr.device), ptr_from_counts(wanted, device=ptr.device)


def _rows_from_start(where: str, ptr: Tensor, start: Tensor | None, seeds: Tensor | None) -> Tensor | None:
    """Return the rows of every cloud, the one to start at first; None where they stay in order."""
    if start is not None and seeds is not None:
        raise ConfigError(f"{where}: give either start, a row of each cloud, or seeds to draw it from")
    if start is None and seeds is None:
        return None
    sizes = counts_from_ptr(ptr)
    if seeds is not None:
        start = torch.where(
            sizes > 0, (words(seeds, torch.zeros_like(seeds)) >> 1 & (2**62 - 1)) % sizes.clamp(min=1), 0
        )
    assert start is not None
    for number, (first, size) in enumerate(zip(on_host(start).tolist() if seeds is None else (), counts_of(ptr))):
        if not 0 <= first < max(1, size):
            raise OutOfRangeError(
                f"{where}: start {first} is no row of cloud {number}, which has {size}; "
                "rows are counted within each cloud, from 0"
            )
    cloud = cloud_of_rows(ptr)
    row = torch.arange(len(cloud), dtype=torch.int64, device=ptr.device) - ptr[cloud]
    own = start[cloud]
    # Row 0 of the new order is the start; those before it move one down, and the others keep their place.
    return ptr[cloud] + torch.where(row == 0, own, torch.where(row <= own, row - 1, row))


def _equal_shares(sizes: Tensor, owner: Tensor, counts: Tensor) -> Tensor:
    """Share the (B,) counts of clouds among their groups of (G,) sizes, as equally as the sizes allow: (G,) int64."""
    groups_ptr = ptr_from_counts(torch.zeros_like(counts).index_add_(0, owner, torch.ones_like(owner)))

    def taken(level: Tensor) -> Tensor:  # of each cloud, with at most so many from each of its groups
        return segment_sum(torch.minimum(sizes, level[owner]), groups_ptr)

    low, high = torch.zeros_like(counts), counts + 1  # a level that takes no more than wanted, and one above
    while bool((high - low > 1).any()):
        middle = (low + high) // 2
        fits = taken(middle) <= counts
        low, high = torch.where(fits, middle, low), torch.where(fits, high, middle)
    share = torch.minimum(sizes, low[owner])
    has_more = sizes > share
    place = has_more.cumsum(0) - has_more.long()  # among those that have more, from the batch's first
    place = place - torch.cat([place, place.new_zeros(1)])[groups_ptr[:-1]][owner]
    return share + (has_more & (place < (counts - taken(low))[owner])).long()


def _farthest_side_by_side(points: Tensor, begin: Tensor, end: Tensor, count: int) -> Tensor:
    """Sample (b,) clouds, rows begin:end, together: all distances are updated for each pick, in buffers made once.

    The farthest point is found as the first tile that holds the maximum, then the first point in it: torch takes maxima
    thirty times faster than their positions. Returns (b, count) rows; those beyond a cloud's size mean nothing.
    """
    num, longest = len(begin), int((end - begin).max())
    begin, end = uploaded(begin, points.device), uploaded(end, points.device)
    width = min(_TILE, longest)
    length = -(-longest // width) * width
    place = torch.arange(length, dtype=torch.int64, device=points.device)
    real = place < (end - begin)[:, None]
    row = torch.where(real, begin[:, None] + place, begin[:, None])
    axes = [column[row] for column in points.unbind(1)]
    # Squared distance to the nearest pick so far; -1, below every distance there is, marks taken points and padding.
    nearest = torch.full_like(axes[0], torch.inf).masked_fill_(~real, -1.0)
    tiles = nearest.view(num, -1, width)
    squared, difference = torch.empty_like(nearest), torch.empty_like(nearest)
    picked = torch.empty((num, count), dtype=torch.int64, device=points.device)
    latest = torch.zeros((num, 1), dtype=torch.int64, device=points.device)
    for step in range(count):
        picked[:, step : step + 1] = latest
        torch.sub(axes[0], axes[0].gather(1, latest), out=squared).square_()
        for axis in axes[1:]:
            torch.sub(axis, axis.gather(1, latest), out=difference)
            squared += difference.square_()
        torch.minimum(nearest, squared, out=nearest)
        nearest.scatter_(1, latest, -1.0)
        # argmax returns the first of equals, as torch documents.
        tile = tiles.amax(dim=2).argmax(dim=1)
        within = tiles.gather(1, tile[:, None, None].expand(-1, 1, width)).squeeze(1).argmax(dim=1)
        latest = (tile * width + within)[:, None]
    return begin[:, None] + picked
