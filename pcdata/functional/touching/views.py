"""Objects of one scene that several cameras saw: the evidence of all views is added up before any of it decides.

Source: Keuper et al., Efficient decomposition of image and mesh graphs by lifted multicuts, ICCV 2015 (greedy additive
edge contraction).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from pcdata.functional.image_clusters import lowest_rows
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.touching.basins import find_basins
from pcdata.functional.touching.chords import Sight, free_chords
from pcdata.functional.touching.contraction import Edge, contracted
from pcdata.functional.touching.joining import Objects, join_hollows, merge_weak_contacts
from pcdata.functional.touching.limits import KINECT_NOISE, Limits
from pcdata.functional.touching.separation import Cut, Join, Separation, in_order_of_rows, regions_of
from pcdata.functional.touching.windows import spread

# Metres, at the noise of a Kinect: surfaces that two views saw in one cell of this edge are the same surface.
_CELL = 0.01
# Cells whose regions touch with less than this strength are drawn together, others driven apart. Lower than in one
# image: there a whole contact decides, here a view that cannot resolve one says 0.
_DRAWN_TOGETHER = 0.2
# Every so many-th cell is an end of lines: some 20 on a thing as large as a cup.
_EVERY = 16
# A region of which this part lies in one object belongs to it as a whole: its border is as sharp as the image.
_WHOLE = 0.9


class View(NamedTuple):
    """What one camera saw of the cloud."""

    rows: Tensor  # (n,) int64 rows of the cloud, in the order of their pixels
    grid: ImageGrid  # where they lie on its image


def separate_views(
    points: Tensor,  # (N, 3) float32, what stands on the table and nothing else
    views: Sequence[View],
    *,
    height: Tensor | None = None,  # (N,) metres above the table
    noise: float | None = None,
    colors: Tensor | None = None,  # (N, 3) float in [0, 1]
    limits: Limits | None = None,
    backend: str = "auto",
) -> Separation:
    """Part the objects of a cloud that was merged from several images.

    Every image is cut into smooth regions whose contacts are judged, as in
    :func:`~pcdata.functional.touching.separation.separate_objects`. Space is cut into cells that know which region each
    view saw there. Wherever neighboring cells differ, every view that saw both says how strongly their regions are
    apart; parts are joined, those with most evidence first, as long as the sum over all views draws them together. So
    one view that sees two objects as one is outvoted by those that see between them, and what an object in front parts
    in one view is joined by another. Objects are nearly convex, but for bowls and cups: the more of the lines between
    points of two parts lead through space that a camera saw to be free, the more they are driven apart.

    Args:
        points: in metres.
        views: of a row at most one knows it; rows of none take the object of their cell.
        height: above the table; without it bowls and cups may come apart into their inside and their wall.
        noise: as there; None = estimated view by view.
        colors: as there.
        limits: as there.
        backend: as there.
    """
    # Regions that are too many cost little where views vote; those that hold two objects cannot be parted again. What
    # jumps part is parted below, without what is small.
    limits = limits or Limits(roughest=2.0, seed_area=0.8e-4, rough_area=0.8e-4, part_area=math.inf)
    region = torch.full((len(points),), -1, dtype=torch.int64, device=points.device)
    view_of_row = torch.full_like(region, -1)
    evidence = _Evidence()
    for number, (rows, grid) in enumerate(views):
        if not len(rows):
            continue
        own_height = None if height is None else height[rows]
        own_colors = None if colors is None else colors[rows]
        objects, own = regions_of(points[rows], grid, own_height, noise, limits, backend, own_colors, over_jumps=False)
        region[rows] = torch.where(own >= 0, own + evidence.num_regions, -1)
        view_of_row[rows] = number
        evidence.add(objects, grid)
    if evidence.num_regions == 0:
        return Separation(region, evidence.noise, 0, (), ())
    cell, cell_regions, pairs = _cells(points, region, view_of_row, len(views), _CELL * spread(evidence.noise))
    part, pairs = _parts(cell_regions, pairs)
    chords = _chords_of_parts(points, height, cell, part, evidence)
    node = _node_of_cells(part, pairs, cell_regions, chords, evidence)
    label, _ = in_order_of_rows(_of_rows(node[cell], region, evidence.num_regions))
    object_of = _object_of_regions(label, region, evidence.num_regions)
    cuts: dict[tuple[int, int], tuple[float, int]] = {}
    for (a, b), (total, count) in evidence.contacts.items():
        one, other = sorted((object_of[a], object_of[b]))
        if one >= 0 and one != other:
            before = cuts.get((one, other), (0.0, 0))
            cuts[one, other] = before[0] + total, before[1] + count
    return Separation(
        label,
        evidence.noise,
        evidence.num_regions,
        tuple(Cut(pair, total / count, count) for pair, (total, count) in sorted(cuts.items())),
        tuple(Join(one, "hollow") for one in sorted({object_of[group[0]] for group in evidence.hollows} - {-1})),
    )


class _Evidence:
    """What the views say of their regions, numbered on from view to view."""

    def __init__(self) -> None:
        self.num_regions = 0
        self.noise = KINECT_NOISE / 1e6
        self.contacts: dict[tuple[int, int], tuple[float, int]] = {}  # sum of strengths, pixels
        self.hollows: list[list[int]] = []  # regions that are one
        self.sights: list[Sight] = []

    def add(self, objects: Objects, grid: ImageGrid) -> None:
        first = self.num_regions
        self.num_regions += objects.scene.num_regions
        self.noise = max(self.noise, objects.scene.noise)
        for (a, b), sums in objects.sums.items():
            self.contacts[a + first, b + first] = sums
        merge_weak_contacts(objects)
        join_hollows(objects)
        motion = None if grid.camera_from_points is None else grid.camera_from_points[0].double()
        self.sights.append(Sight(objects.scene, motion))
        hollow = {objects.object_of[one] for one, _ in objects.joins}
        self.hollows += [[one + first for one in members] for of, members in objects.members().items() if of in hollow]

    def strengths(self) -> Tensor:
        """Return (R, R) how strongly two regions of a view are apart: fully where they do not touch in it."""
        apart = torch.ones(self.num_regions, self.num_regions, dtype=torch.float64, device="cpu")
        for (a, b), (total, count) in self.contacts.items():
            apart[a, b] = apart[b, a] = total / count
        for group in self.hollows:
            rows = torch.tensor(group, dtype=torch.int64, device="cpu")
            apart[rows[:, None], rows] = 0
        return apart.fill_diagonal_(0)


def _cells(points: Tensor, region: Tensor, view: Tensor, num_views: int, edge: float) -> tuple[Tensor, Tensor, Tensor]:
    """Cut space into cells: those of the rows (N,), the region that most rows of each view have (C, V), neighbors."""
    place = (points.double() / edge).floor().to(torch.int64)
    place = place - place.amin(0) + 1
    size = (place.amax(0) + 2).tolist()
    code, cell = ((place[:, 0] * size[1] + place[:, 1]) * size[2] + place[:, 2]).unique(return_inverse=True)
    seen = region >= 0
    most = int(region.max()) + 1
    pair, count = (cell[seen] * most + region[seen]).unique(return_counts=True)
    view_of = torch.zeros(most, dtype=torch.int64, device=points.device)
    view_of[region[seen]] = view[seen]
    slot = pair // most * num_views + view_of[pair % most]
    # Most rows win, of equals the lowest region: the last of each slot.
    order = (-pair).argsort()
    order = order[count[order].argsort(stable=True)]
    order = order[slot[order].argsort(stable=True)]
    last = torch.ones_like(order, dtype=torch.bool)
    last[:-1] = slot[order][1:] != slot[order][:-1]
    regions = torch.full((len(code) * num_views,), -1, dtype=torch.int64, device=points.device)
    regions[slot[order[last]]] = pair[order[last]] % most
    pairs = []
    for x, y, z in torch.cartesian_prod(*[torch.arange(-1, 2, dtype=torch.int64, device="cpu")] * 3).tolist():
        step = (x * size[1] + y) * size[2] + z
        if step > 0:
            beside = torch.searchsorted(code, code + step).clamp(max=len(code) - 1)
            there = code[beside] == code + step
            pairs.append(torch.stack([there.nonzero().squeeze(1), beside[there]]))
    return cell, regions.reshape(len(code), num_views), torch.cat(pairs, 1)


def _parts(regions: Tensor, pairs: Tensor) -> tuple[Tensor, Tensor]:
    """Number connected cells in which every view saw the same; also return the pairs of cells that differ."""
    same = (regions[pairs[0]] == regions[pairs[1]]).all(1)
    _, part = lowest_rows(pairs[:, same], len(regions), regions.device).unique(return_inverse=True)
    return part, pairs[:, ~same]


def _chords_of_parts(
    points: Tensor, height: Tensor | None, cell: Tensor, part: Tensor, evidence: _Evidence
) -> dict[tuple[int, int], tuple[int, int]]:
    """Return how many lines between two parts cameras see through, and how many lines there are."""
    num_cells = len(part)
    chosen = torch.arange(0, num_cells, _EVERY, dtype=torch.int64, device=points.device)
    count = torch.bincount(cell, minlength=num_cells).double().clamp(min=1)
    means = torch.zeros(num_cells, 3, dtype=torch.float64, device=points.device).index_add_(0, cell, points.double())
    heights, basins = None, None
    if height is not None:
        basins = find_basins(points.double(), height.double())
        level = torch.zeros(num_cells, dtype=torch.float64, device=points.device)
        heights = (level.index_add_(0, cell, height.double()) / count)[chosen]
    chords = free_chords((means / count[:, None])[chosen], heights, evidence.sights, basins)
    a, b = part[chosen[chords.first]], part[chosen[chords.second]]
    num_parts = int(part.max()) + 1
    code, place = (torch.minimum(a, b) * num_parts + torch.maximum(a, b)).unique(return_inverse=True)
    total = torch.bincount(place, minlength=len(code))
    free = torch.bincount(place[chords.free], minlength=len(code))
    return {divmod(pair, num_parts): (n, m) for pair, n, m in zip(code.tolist(), free.tolist(), total.tolist())}


def _node_of_cells(
    part: Tensor,
    pairs: Tensor,
    regions: Tensor,
    chords: dict[tuple[int, int], tuple[int, int]],
    evidence: _Evidence,
) -> Tensor:
    """Join parts, those with the largest sum first, as long as it draws them together; return each cell's object."""
    num_parts = int(part.max()) + 1
    one, other = regions[pairs[0]], regions[pairs[1]]
    both = (one >= 0) & (other >= 0)
    apart = evidence.strengths().to(regions.device)[one.clamp(min=0), other.clamp(min=0)]
    draw = torch.where(both, _DRAWN_TOGETHER - apart, 0.0).sum(1)
    a, b = part[pairs[0]], part[pairs[1]]
    differ = (a != b) & both.any(1)
    code, place = (torch.minimum(a, b) * num_parts + torch.maximum(a, b))[differ].unique(return_inverse=True)
    total = torch.zeros(len(code), dtype=torch.float64, device=draw.device).index_add_(0, place, draw[differ])
    weight = torch.zeros(len(code), dtype=torch.int64, device=draw.device).index_add_(0, place, both.sum(1)[differ])
    edges = {
        divmod(pair, num_parts): Edge(value, seen)
        for pair, value, seen in zip(code.tolist(), total.tolist(), weight.tolist())
    }
    for pair, (free, lines) in chords.items():
        if pair[0] != pair[1]:
            edges[pair] = edges.get(pair, Edge())._replace(free=free, lines=lines)
    beside: list[dict[int, Edge]] = [{} for _ in range(num_parts)]
    for (first, second), edge in edges.items():
        beside[first][second] = beside[second][first] = edge
    of = contracted(beside, torch.bincount(part, minlength=num_parts).tolist())
    return torch.tensor(of, dtype=torch.int64, device=part.device)[part]


def _of_rows(node: Tensor, region: Tensor, num_regions: int) -> Tensor:
    """Return each row's object: that of its region where nearly all of it lies in one, else that of its cell."""
    ids, own = node.unique(return_inverse=True)
    seen = region >= 0
    code, count = (region[seen] * len(ids) + own[seen]).unique(return_counts=True)
    total = torch.bincount(region[seen], minlength=num_regions)
    whole = torch.full((num_regions,), -1, dtype=torch.int64, device=node.device)
    most = count > _WHOLE * total[code // len(ids)]
    whole[code[most] // len(ids)] = code[most] % len(ids)
    found = whole[region.clamp(min=0)]
    return torch.where(seen & (found >= 0), found, own)


def _object_of_regions(label: Tensor, region: Tensor, num_regions: int) -> list[int]:
    """Return the object that most rows of each region have, the lowest of equals; -1 of one without rows."""
    seen = (region >= 0) & (label >= 0)
    most = int(label.max()) + 1 if len(label) else 1
    code, count = (region[seen] * most + label[seen]).unique(return_counts=True)
    own = [-1] * num_regions
    largest = [0] * num_regions
    for pair, size in zip(code.tolist(), count.tolist()):
        one, of = divmod(pair, most)
        if size > largest[one]:
            own[one], largest[one] = of, size
    return own
