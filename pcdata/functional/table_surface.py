"""Which points are the table itself: its bend and its noise are measured, so the feet of what stands on it are kept."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner, op
from pcdata.contracts.numbers import checked_length, checked_positive
from pcdata.contracts.on_host import bounds_of, counts_of
from pcdata.errors import ConfigError, NoPlaneError, ShapeError
from pcdata.functional.clusters import dbscan
from pcdata.functional.enclosed import enclosed_points
from pcdata.functional.image_clusters import linked_pixels
from pcdata.functional.image_grid import ImageGrid, checked_grid, is_lined
from pcdata.functional.neighbors import knn
from pcdata.functional.plane_steps import fit_planes
from pcdata.functional.rows import cloud_of_rows, pick_rows, ptr_after_mask
from pcdata.functional.surface_fit import fit_surface, reaches

# Of the distance: what makers of depth cameras allow theirs within its range, and more than the good ones have.
_WORST_NOISE = 0.02
_MOST_CLUTTER = 0.5  # of what lies within the noise; more, and the surface is not what most of it is about
_WINDOW = 9  # points whose median is a point's height: itself and the pixels around it
_EXCHANGES = [
    *((1, 2), (4, 5), (7, 8), (0, 1), (3, 4), (6, 7), (1, 2), (4, 5), (7, 8), (0, 3)),
    *((5, 8), (4, 7), (3, 6), (1, 4), (2, 5), (4, 7), (4, 2), (6, 4), (4, 2)),
]


class TableSurface(NamedTuple):
    """What :func:`table_surface` found in B clouds of N points."""

    table: Tensor  # (N,) bool: the points of the table itself, and crumbs; none where no table was measured
    below: Tensor  # (N,) bool: the points under the table, or under the plane as given
    flat: Tensor  # (N,) bool: those of them within its noise, which hull and planes are made of
    height: Tensor  # (N,) float32 above its surface, on the side that the normal points to
    noise: Tensor  # (B,) float64 standard deviation of height at the table's median distance from the viewpoint
    disparity_noise: Tensor  # (B,) float64 the same of 1 / distance from the viewpoint; NaN where that is not known
    planes: Tensor  # (B, 4) float64, refitted to the table itself
    believed: Tensor  # (B,) bool: False where no table was measured, and the rest is that of the plane as given


def _checked_viewpoint(where: str, name: str, arguments: Mapping[str, Any]) -> Tensor:
    """Require a finite place (3,) for all, one per cloud (B, 3) or one per point (N, 3); bodies get one of the latter.

    They are float64.
    """
    points, ptr = arguments["points"], arguments["ptr"]
    places = torch.as_tensor(arguments[name], dtype=torch.float64, device=points.device).detach()
    if places.shape not in {(3,), (len(ptr) - 1, 3), tuple(points.shape)}:
        raise ShapeError(
            f"{where}: {name} must be (3,), ({len(ptr) - 1}, 3) or {tuple(points.shape)}, got {tuple(places.shape)}"
        )
    if not bool(torch.isfinite(places).all()):
        raise ConfigError(f"{where}: {name} must be finite")
    return places.expand(len(ptr) - 1, 3) if places.ndim == 1 else places


@inner
def window_medians(
    values: Tensor, points: Tensor, ptr: Tensor, grid: ImageGrid | None, *, backend: str = "auto"
) -> Tensor:
    """Return for every point the lower median of the values (N,) of the pixels around it and its own.

    Those are the 3 x 3 pixels of a grid that have a point; without a grid the 9 nearest points, itself among them.
    """
    if grid is None:
        return _medians_around(values, ptr, _around(points, ptr))
    height, width = grid.size
    medians = []
    for start, stop in pairwise(bounds_of(ptr)):
        pixel = grid.pixel_index[start:stop]
        image = torch.full((height + 2, width + 2), torch.nan, dtype=values.dtype, device=values.device)
        row, column = pixel // width + 1, pixel % width + 1
        image[row, column] = values[start:stop]
        around = [image[row + up, column + right] for up in (-1, 0, 1) for right in (-1, 0, 1)]
        middle = _middle_of_nine(around)
        broken = middle.isnan()  # windows with a pixel that has no point
        middle[broken] = torch.stack([one[broken] for one in around], 1).nanmedian(1).values
        medians.append(middle)
    return torch.cat(medians)


def _around(points: Tensor, ptr: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Return for every cloud that has points the up to 9 nearest of each, itself among them: index and distance."""
    return [
        knn(points[start:stop], k=min(_WINDOW, stop - start))
        for start, stop in pairwise(bounds_of(ptr))
        if stop > start
    ]


def _medians_around(values: Tensor, ptr: Tensor, around: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
    own = [values[start:stop] for start, stop in pairwise(bounds_of(ptr)) if stop > start]
    return torch.cat([rows[index].median(1).values for rows, (index, _) in zip(own, around)] or [values])


def _middle_of_nine(values: list[Tensor]) -> Tensor:
    """Return the medians of nine tensors, element by element; NaN where one of them is.

    Source: Smith, Implementing median filters in XC4000E FPGAs, Xcell 23, 1996: 19 exchanges leave it in the middle.
    """
    sorted_ = list(values)
    for low, high in _EXCHANGES:
        a, b = sorted_[low], sorted_[high]
        sorted_[low], sorted_[high] = torch.minimum(a, b), torch.maximum(a, b)
    return sorted_[4]


@op(
    points="N 3",
    ptr="ptr N B",
    planes="B 4 : float64",
    distance=checked_length,
    viewpoint=_checked_viewpoint,
    cut=checked_positive,
    min_height=checked_positive,
    min_size=checked_length,
    max_noise=checked_length,
    grid=checked_grid,
    steps=(reaches, fit_surface, window_medians, linked_pixels, fit_planes),
    gradient=False,
)
def table_surface(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    planes: Tensor,  # (B, 4) float64
    distance: float = 0.01,
    viewpoint: Tensor | Sequence[float] | None = None,
    cut: float = 2.5,
    min_height: float = 8.0,
    min_size: float = 0.02,
    max_noise: float | None = None,
    grid: ImageGrid | None = None,
    backend: str = "auto",
) -> TableSurface:
    """Tell the points of a table from what stands on it, by the table's own bend and noise.

    The points near each plane are fitted by a surface of second order over it, as sensors bend planes by a few
    millimetres, and by their noise about it. That grows with the distance from the viewpoint: sensors by triangulation
    have one noise of 1 / distance, which makes that of heights over a plane proportional to the distance. A point is
    suspected to stand on the table where the median height of the points around it (the 3 x 3 pixels of ``grid``, else
    the 9 nearest) exceeds ``cut`` times the noise there. Connected suspects are something where they cover at least
    ``min_size`` squared at more than ``min_height`` times the noise; the rest is an edge, a crumb or a reflection, and
    counts as table. So does what is below it, unless by more than ``distance`` and, by medians, than the cut. With a
    ``grid``, what something encloses is a part of it, as the floor of a bowl: see :func:`enclosed_points`.

    A measured surface is not believed where half of what lies within its noise is clutter that crosses it, or where the
    noise is more than a depth camera has: 2 % of the way to it, ``max_noise``, or ``distance`` itself where the
    viewpoint is not known. No table hides what crosses it on both sides, so what lies there is not one: no point is the
    table's. Then ``flat`` is what is nearer than ``distance`` to the plane as given and ``below`` what is farther under
    it; heights are over that plane, and its noise is NaN.

    Args:
        points: the clouds, in any unit of length.
        ptr: row pointers.
        planes: (B, 4), one per cloud, as :func:`supporting_plane` finds them; normals toward what stands on them.
        distance: where the table is looked for at first; what a viewpoint explains may be more.
        viewpoint: where the sensor stood, (3,), (B, 3), or (N, 3) for every point; None = the same noise everywhere.
        cut: standard deviations of single points; medians vary by less than half as much.
        min_height: standard deviations that something must rise to.
        min_size: edge of a square as large as what it must cover.
        max_noise: the most standard deviation of 1 / distance from the viewpoint that is believed; None = any.
        grid: the depth image the points still lie on; it says which points are around a point and which are connected.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        ShapeError: there is not one plane per cloud.
        NoPlaneError: a plane's normal is zero, or it has fewer than 3 points nearer than ``distance``.
    """
    assert ptr is not None  # @op fills it
    assert viewpoint is None or isinstance(viewpoint, Tensor)  # and makes it (B, 3) or (N, 3)
    points, planes = points.contiguous(), planes.contiguous()  # sums over strides are taken in another order
    length = planes[:, :3].norm(dim=1, keepdim=True)
    if bool((length == 0).any()):
        raise NoPlaneError("table_surface: planes must have a normal that is not zero")
    planes = planes / length
    reach = points.new_ones(len(points), dtype=torch.float64)
    if viewpoint is not None:
        reach = reaches(points, ptr, viewpoint, distance, backend=backend)
    fits, sides = [], []
    for b, (start, stop) in enumerate(_bounds(ptr)):
        own = points[start:stop], reach[start:stop], planes[b]
        fits.append(fit_surface(*own, distance, f"cloud {b}", backend=backend))
        sides.append(math.nan)
        if viewpoint is not None and stop > start:
            places = viewpoint[start:stop] if len(viewpoint) == len(points) else viewpoint[b : b + 1]
            aside = abs(float((places @ planes[b, :3] + planes[b, 3]).median()))
            sides[-1] = aside if aside > distance else math.nan
    heights = torch.cat([fit.height for fit in fits])
    sigmas, typical, clutter, side = (
        torch.tensor(values, dtype=torch.float64, device=points.device)
        for values in (*zip(*((fit.noise, fit.typical, fit.clutter) for fit in fits)), sides)
    )
    worst = distance if viewpoint is None else _WORST_NOISE
    believed = (clutter <= _MOST_CLUTTER) & (sigmas <= worst)
    if max_noise is not None:
        believed &= ~(sigmas / side > max_noise)  # NaN is not known to be more
    spread = torch.cat([fit.noise * reach[start:stop] for fit, (start, stop) in zip(fits, _bounds(ptr))])
    rise = (heights / spread).float()
    if grid is None:
        around = _around(points, ptr)
        rise, areas = _medians_around(rise, ptr, around), _areas_around(points, around)
    else:
        rise, areas = window_medians(rise, points, ptr, grid, backend=backend), None
    something = _standing(points, ptr, rise, areas, cut, min_height, min_size, grid, 5 * distance, backend)
    if grid is not None:
        something |= enclosed_points(something, rise, min_height, ptr, grid, backend=backend)
    below = ~something & (rise < -cut) & (heights < -distance)
    table = ~(something | below)
    flat = table & (heights.abs() < cut * spread)
    if not bool(believed.all()):
        cloud = cloud_of_rows(ptr)
        x, y, z = points.double().unbind(1)
        nx, ny, nz, offset = planes[cloud].unbind(1)
        over_plane = ((nx * x + ny * y) + nz * z) + offset
        heights = torch.where(believed[cloud], heights, over_plane)
        table &= believed[cloud]
        below = torch.where(believed[cloud], below, over_plane <= -distance)
        flat = torch.where(believed[cloud], flat, over_plane.abs() < distance)
    refitted = fit_planes(points, ptr, flat, backend=backend).to(points.device)
    # Those of a line stay, and those that are not believed.
    refitted = torch.where(believed[:, None] & ~refitted[:, :1].isnan(), refitted, planes)
    turned = (refitted[:, :3] * planes[:, :3]).sum(1, keepdim=True) < 0
    return TableSurface(
        table,
        below,
        flat,
        heights.float(),
        torch.where(believed, sigmas * typical, math.nan),
        torch.where(believed, sigmas / side, math.nan),
        torch.where(turned, -refitted, refitted),
        believed,
    )


def _bounds(ptr: Tensor) -> list[tuple[int, int]]:
    return list(pairwise(bounds_of(ptr)))


def _pixel_areas(points: Tensor, ptr: Tensor, grid: ImageGrid) -> Tensor:  # (N,) float64
    """Return the area that each point stands for: that of its pixel at its depth.

    Pixels are taken as facing the camera; an area that leans away is larger.
    """
    cloud = cloud_of_rows(ptr)
    focal = (grid.intrinsics[:, 0, 0] * grid.intrinsics[:, 1, 1]).double().abs()
    depth = points[:, 2].double()
    if grid.camera_from_points is not None:
        row = grid.camera_from_points[:, 2].double()
        depth = (points.double() * row[cloud, :3]).sum(1) + row[cloud, 3]
    return depth.square() / focal[cloud]


def _areas_around(points: Tensor, around: Sequence[tuple[Tensor, Tensor]]) -> Tensor:  # (N,) float64
    """Return the area that each point stands for: what its nearest neighbors leave to it."""
    # A disk that reaches to the eighth neighbor holds nine points, of which those on the rim count half.
    areas = [math.pi * distance[:, -1].double().square() / distance.shape[1] for _, distance in around]
    return torch.cat(areas or [points.new_zeros(0, dtype=torch.float64)])


def _standing(
    points: Tensor,
    ptr: Tensor,
    rise: Tensor,
    areas: Tensor | None,  # (N,) float64 that points stand for; None = those of their pixels
    cut: float,
    min_height: float,
    min_size: float,
    grid: ImageGrid | None,
    reach: float,
    backend: str,
) -> Tensor:  # (N,) bool
    """Mark the suspects that are something: in connected parts that cover enough at more than the least height."""
    suspect = rise > cut
    fields = {"points": points, "rise": rise}
    if areas is not None:
        fields["area"] = areas
    if grid is not None:
        fields["pixel"] = grid.pixel_index
    own, own_ptr = pick_rows(fields, suspect), ptr_after_mask(suspect, ptr)
    if grid is not None:
        on = ImageGrid(own["pixel"], grid.size, grid.intrinsics, grid.camera_from_points)
        own["area"] = _pixel_areas(own["points"], own_ptr, on)
    part, num_parts = _connected(own["points"], own_ptr, own.get("pixel"), grid, ptr, reach, backend)
    high = torch.where(own["rise"] > min_height, own["area"], 0.0)
    covered = torch.zeros(num_parts, dtype=torch.float64, device=points.device).index_add_(0, part, high.double())
    suspect[suspect.clone()] = (covered >= min_size**2)[part]
    return suspect


def _connected(
    own: Tensor, own_ptr: Tensor, pixel: Tensor | None, grid: ImageGrid | None, ptr: Tensor, reach: float, backend: str
) -> tuple[Tensor, int]:  # (suspects,) part, their number over all clouds
    """Number the connected parts of the suspects, points ``own`` on pixels of a grid, of clouds with ``ptr``."""
    if not len(own):
        return own_ptr.new_zeros(0), 0
    if grid is None or pixel is None:
        part = dbscan(own, own_ptr, eps=reach / 2, min_points=1)
    else:
        part = torch.cat(
            [
                linked_pixels(
                    own[first:last],
                    own_ptr.new_tensor([0, last - first]),
                    pixel[first:last],
                    grid.size,
                    reach,
                    1 + is_lined(grid.pixel_index[start:stop], grid.size),
                    backend=backend,
                )
                for (first, last), (start, stop) in zip(_bounds(own_ptr), _bounds(ptr))
            ]
        )
    count = torch.stack([one.max() + 1 if len(one) else part.new_zeros(()) for one in part.split(_sizes(own_ptr))])
    offset = torch.cat([count.new_zeros(1), count.cumsum(0)])
    return part + offset[cloud_of_rows(own_ptr)], int(offset[-1])


def _sizes(ptr: Tensor) -> list[int]:
    return [int(one) for one in counts_of(ptr)]
