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
from pcdata.errors import ConfigError, NoPlaneError, ShapeError
from pcdata.functional.clusters import dbscan
from pcdata.functional.image_clusters import linked_pixels
from pcdata.functional.image_grid import ImageGrid, checked_grid
from pcdata.functional.neighbors import knn
from pcdata.functional.planes import fit_planes
from pcdata.functional.rows import cloud_of_rows, counts_from_ptr, ptr_after_mask
from pcdata.functional.selection import plane_axes

# Points of a cloud that the surface is fitted to.
_SAMPLE = 1 << 15
_ROUNDS = 8  # of fitting and choosing inliers again; real tables settle in 4 to 6
# Standard deviations within which points are the table's own, for the fit: 1.2 % of normal noise lies outside.
_OWN = 2.5
# A median of absolute deviations times this is a standard deviation, of normal noise.
_MAD = 1.4826
_LEAST_NOISE = 0.05  # of the distance: real tables are no flatter, whatever a noise-free renderer shows
_MOST_SPREAD = 3.0  # distances from the plane that the search for its noise may go
_WINDOW = 9  # points whose median is a point's height: itself and the pixels around it
_EXCHANGES = [
    *((1, 2), (4, 5), (7, 8), (0, 1), (3, 4), (6, 7), (1, 2), (4, 5), (7, 8), (0, 3)),
    *((5, 8), (4, 7), (3, 6), (1, 4), (2, 5), (4, 7), (4, 2), (6, 4), (4, 2)),
]


class TableSurface(NamedTuple):
    """What :func:`table_surface` found in B clouds of N points."""

    table: Tensor  # (N,) bool: the points of the table itself
    height: Tensor  # (N,) float32 above its surface, on the side that the normal points to
    noise: Tensor  # (B,) float64 standard deviation of height at the table's median distance from the viewpoint
    disparity_noise: Tensor  # (B,) float64 the same of 1 / distance from the viewpoint; NaN where that is not known
    planes: Tensor  # (B, 4) float64, refitted to the table itself


def _checked_viewpoint(where: str, name: str, arguments: Mapping[str, Any]) -> Tensor:
    """Require a finite place (3,) for all, one per cloud (B, 3) or one per point (N, 3); bodies get (N, 3) float64."""
    points, ptr = arguments["points"], arguments["ptr"]
    places = torch.as_tensor(arguments[name], dtype=torch.float64, device=points.device).detach()
    if places.shape not in {(3,), (len(ptr) - 1, 3), tuple(points.shape)}:
        raise ShapeError(
            f"{where}: {name} must be (3,), ({len(ptr) - 1}, 3) or {tuple(points.shape)}, got {tuple(places.shape)}"
        )
    if not bool(torch.isfinite(places).all()):
        raise ConfigError(f"{where}: {name} must be finite")
    if places.ndim == 2 and len(places) == len(ptr) - 1 != len(points):
        places = places[cloud_of_rows(ptr)]
    return places.expand(len(points), 3)


@inner
def window_medians(
    values: Tensor, points: Tensor, ptr: Tensor, grid: ImageGrid | None, *, backend: str = "auto"
) -> Tensor:
    """Return for every point the lower median of the values (N,) of the pixels around it and its own.

    Those are the 3 x 3 pixels of a grid that have a point; without a grid the 9 nearest points, itself among them.
    """
    if grid is None:
        return torch.cat(
            [
                values[start:stop][knn(points[start:stop], k=min(_WINDOW, stop - start))[0]].median(1).values
                for start, stop in pairwise(ptr.tolist())
                if stop > start
            ]
            or [values]
        )
    height, width = grid.size
    medians = []
    for start, stop in pairwise(ptr.tolist()):
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
    grid=checked_grid,
    steps=(window_medians, linked_pixels, fit_planes),
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
    counts as table. So does what is below it by less than ``distance``, or than the cut where that is more.

    Args:
        points: the clouds, in any unit of length.
        ptr: row pointers.
        planes: (B, 4), one per cloud, as :func:`supporting_plane` finds them; normals toward what stands on them.
        distance: where the table is looked for at first; its noise may be more.
        viewpoint: where the sensor stood, (3,), (B, 3), or (N, 3) for every point; None = the same noise everywhere.
        cut: standard deviations of single points; medians vary by less than half as much.
        min_height: standard deviations that something must rise to.
        min_size: edge of a square as large as what it must cover.
        grid: the depth image the points still lie on; it says which points are around a point and which are connected.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        ShapeError: there is not one plane per cloud.
        NoPlaneError: a plane's normal is zero, or it has fewer than 3 points nearer than ``distance``.
    """
    assert ptr is not None  # @op fills it
    assert viewpoint is None or isinstance(viewpoint, Tensor)  # and makes it (N, 3)
    points, planes = points.contiguous(), planes.contiguous()  # sums over strides are taken in another order
    length = planes[:, :3].norm(dim=1, keepdim=True)
    if bool((length == 0).any()):
        raise NoPlaneError("table_surface: planes must have a normal that is not zero")
    planes = planes / length
    reach = points.new_ones(len(points), dtype=torch.float64)
    if viewpoint is not None:
        reach = (points.double() - viewpoint).norm(dim=1).clamp(min=distance)
    height, noise, typical, sides = [], [], [], []
    for b, (start, stop) in enumerate(pairwise(ptr.tolist())):
        own, sigma, far = _heights(points[start:stop], reach[start:stop], planes[b], distance, f"cloud {b}")
        height.append(own)
        noise.append(sigma)
        typical.append(far)
        sides.append(math.nan)
        if viewpoint is not None and stop > start:
            side = abs(float((viewpoint[start:stop] @ planes[b, :3] + planes[b, 3]).median()))
            sides[-1] = side if side > distance else math.nan
    heights, sigmas = torch.cat(height), torch.tensor(noise, dtype=torch.float64, device=points.device)
    cloud = cloud_of_rows(ptr)
    rise = window_medians((heights / (sigmas[cloud] * reach)).float(), points, ptr, grid, backend=backend)
    suspect = rise > cut
    area = point_areas(points, ptr, grid)
    part, num_parts = _connected(points, ptr, suspect, grid, 5 * distance, backend)
    high = torch.where(rise[suspect] > min_height, area[suspect], 0.0)
    covered = torch.zeros(num_parts, dtype=torch.float64, device=points.device).index_add_(0, part, high.double())
    something = torch.zeros_like(suspect)
    something[suspect] = (covered >= min_size**2)[part]
    below = heights < -torch.clamp(cut * sigmas[cloud] * reach, min=distance)
    table = ~(something | below)
    refitted = fit_planes(points, ptr, table, backend=backend).to(points.device)
    refitted = torch.where(refitted[:, :1].isnan(), planes, refitted)  # those of a line
    turned = (refitted[:, :3] * planes[:, :3]).sum(1, keepdim=True) < 0
    return TableSurface(
        table,
        heights.float(),
        sigmas * torch.tensor(typical, dtype=torch.float64, device=points.device),
        sigmas / torch.tensor(sides, dtype=torch.float64, device=points.device),
        torch.where(turned, -refitted, refitted),
    )


def _bounds(ptr: Tensor) -> list[tuple[int, int]]:
    return list(pairwise(ptr.tolist()))


def _heights(
    points: Tensor, reach: Tensor, plane: Tensor, distance: float, where: str
) -> tuple[Tensor, float, float]:  # (n,) float64, noise, median reach of the table
    """Return heights above the surface of second order that a cloud's table is, and their noise per unit of reach."""
    # Sums of columns, in one order: a product of matrices depends on how its library finds them in memory.
    x, y, z = points.double().unbind(1)
    nx, ny, nz, offset = plane.unbind()
    flat_height = ((nx * x + ny * y) + nz * z) + offset
    flat = [(x * axis[0] + y * axis[1]) + z * axis[2] for axis in plane_axes(plane).unbind(1)]
    step = max(1, math.ceil(len(points) / _SAMPLE))
    near = flat_height[::step].abs() < distance
    if int(near.sum()) < 3:
        raise NoPlaneError(
            f"table_surface: {where}: the plane has {int(near.sum())} points nearer than distance={distance:g}; is it "
            "in the coordinates of the cloud?"
        )
    # Beyond the points that it is fitted to, the surface goes on level: parabolas would leave.
    scaled = []
    for along in flat:
        own = along[::step][near]
        lower, upper = own.min(), own.max()
        scaled.append(((along - lower) / ((upper - lower) / 2).clamp(min=distance) - 1).clamp(-1, 1))
    some = [along[::step] for along in scaled]
    height, weight = flat_height[::step], 1 / reach[::step]
    typical = float(reach[::step][near].median())
    least = _LEAST_NOISE * distance / typical
    surface, sigma = plane.new_zeros(6), math.inf
    off = height.abs()
    for _ in range(_ROUNDS):
        spread = max(float((off * weight)[near].median()) * _MAD, least)
        surface = _fitted([along[near] for along in some], height[near], weight[near] / spread, distance)
        off = (height - _on(surface, some)).abs()
        before, sigma = sigma, max(float((off * weight)[near].median()) * _MAD, least)
        near = (off * weight < _OWN * sigma) & (off < _MOST_SPREAD * distance)
        if abs(sigma - before) < 1e-3 * sigma or int(near.sum()) < 3:
            break
    return flat_height - _on(surface, scaled), sigma, typical


def _fitted(flat: list[Tensor], height: Tensor, weight: Tensor, distance: float) -> Tensor:
    """Return the six coefficients of the surface that fits weighted heights best.

    A bend of one distance over half the table's length is as likely as not; level and slopes are as good as free.
    """
    terms = [weight, *(term * weight for term in _terms(flat))]
    target = height * weight
    products = torch.stack([torch.stack([(one * other).sum() for other in terms]) for one in terms])
    stiff = torch.tensor([1e-6] * 3 + [1.0] * 3, dtype=torch.float64, device=height.device) / distance**2
    moments = torch.stack([(one * target).sum() for one in terms])
    return torch.cholesky_solve(moments[:, None], torch.linalg.cholesky(products + torch.diag(stiff)))[:, 0]


def _terms(flat: list[Tensor]) -> list[Tensor]:
    """Return what a surface of second order is made of, besides a constant."""
    s, t = flat
    return [s, t, s * s, s * t, t * t]


def _on(surface: Tensor, flat: list[Tensor]) -> Tensor:
    """Return the heights of a surface."""
    height = surface[0].expand(flat[0].shape)
    for coefficient, term in zip(surface[1:], _terms(flat)):
        height = height + coefficient * term
    return height


def point_areas(points: Tensor, ptr: Tensor, grid: ImageGrid | None) -> Tensor:  # (N,) float64
    """Return the area that each point stands for: that of its pixel at its depth, or what its neighbors leave to it.

    Pixels are taken as facing the camera; an area that leans away is larger.
    """
    if grid is not None:
        cloud = cloud_of_rows(ptr)
        focal = (grid.intrinsics[:, 0, 0] * grid.intrinsics[:, 1, 1]).double().abs()
        depth = points[:, 2].double()
        if grid.camera_from_points is not None:
            row = grid.camera_from_points[:, 2].double()
            depth = (points.double() * row[cloud, :3]).sum(1) + row[cloud, 3]
        return depth.square() / focal[cloud]
    areas = []
    for start, stop in _bounds(ptr):
        # A disk that reaches to the eighth neighbor holds nine points, of which those on the rim count half.
        around = min(_WINDOW, stop - start)
        far = knn(points[start:stop], k=around)[1][:, -1].double() if around else points.new_zeros(0).double()
        areas.append(math.pi * far.square() / max(around, 1))
    return torch.cat(areas)


def _connected(
    points: Tensor, ptr: Tensor, suspect: Tensor, grid: ImageGrid | None, reach: float, backend: str
) -> tuple[Tensor, int]:  # (suspects,) part, their number over all clouds
    """Number the connected parts of the suspects."""
    own, own_ptr = points[suspect], ptr_after_mask(suspect, ptr)
    if not len(own):
        return own_ptr.new_zeros(0), 0
    if grid is not None:
        part = linked_pixels(own, own_ptr, grid.pixel_index[suspect], grid.size, reach, 1, backend=backend)
    else:
        part = dbscan(own, own_ptr, eps=reach / 2, min_points=1)
    count = torch.stack([one.max() + 1 if len(one) else part.new_zeros(()) for one in part.split(_sizes(own_ptr))])
    offset = torch.cat([count.new_zeros(1), count.cumsum(0)])
    return part + offset[cloud_of_rows(own_ptr)], int(offset[-1])


def _sizes(ptr: Tensor) -> list[int]:
    return [int(one) for one in counts_from_ptr(ptr).tolist()]
