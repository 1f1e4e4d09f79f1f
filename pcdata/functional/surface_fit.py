"""The surface of a table and its noise, measured on points of which many may be something else."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner
from pcdata.errors import NoPlaneError
from pcdata.functional.rows import cloud_of_rows
from pcdata.functional.selection import plane_axes

# Points of a cloud that the surface is fitted to.
SAMPLE = 1 << 15
ROUNDS = 12  # of fitting and choosing inliers again; real tables settle in 4 to 6
# Standard deviations within which points are the table's own, for the fit: 1.2 % of normal noise lies outside.
OWN = 2.5
# Standard deviations on either side of the surface between which nothing is the table's: what lies there is clutter,
# and there is as much of it nearer to the surface.
BESIDE = (4.0, 8.0)
# A median of absolute deviations times this is a standard deviation, of normal noise.
MAD = 1.4826
LEAST_NOISE = 0.05  # of the distance: real tables are no flatter, whatever a noise-free renderer shows


class SurfaceFit(NamedTuple):
    """What :func:`fit_surface` found of one cloud."""

    height: Tensor  # (n,) float64 above the surface
    noise: float  # standard deviation of heights, per unit of reach
    typical: float  # median reach of the points it was measured on
    clutter: float  # share of the points within 2.5 deviations that are not the surface's own


@inner
def reaches(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor,
    places: Tensor,  # (N, 3) or (B, 3) float64
    least: float,
    *,
    backend: str = "auto",
) -> Tensor:  # (N,) float64
    """Return how far points are from places, those of all points or of all clouds; at least ``least``."""
    if len(places) != len(points):
        places = places[cloud_of_rows(ptr)]
    x, y, z = (points.double() - places).unbind(1)
    return ((x * x + y * y) + z * z).sqrt().clamp(min=least)


@inner
def fit_surface(
    points: Tensor,  # (n, 3) float32
    reach: Tensor,  # (n,) float64 that the noise is proportional to; ones = the same everywhere
    plane: Tensor,  # (4,) float64, unit normal
    distance: float,
    where: str,
    *,
    backend: str = "auto",
) -> SurfaceFit:
    """Fit a surface of second order over a plane to the points near it, by turns with their noise about it.

    The noise is the median distance of the points within 2.5 standard deviations, without the clutter among them: what
    lies 4 to 8 deviations off, on both sides of the surface alike, goes on through it. So walls and boxes that cross
    the plane do not count as its noise; what stands on one side alone hardly moves a median.

    Raises:
        NoPlaneError: the plane has fewer than 3 points nearer than ``distance``.
    """
    # Sums of columns, in one order: a product of matrices depends on how its library finds them in memory.
    x, y, z = points.double().unbind(1)
    nx, ny, nz, offset = plane.unbind()
    flat_height = ((nx * x + ny * y) + nz * z) + offset
    flat = [(x * axis[0] + y * axis[1]) + z * axis[2] for axis in plane_axes(plane).unbind(1)]
    step = max(1, math.ceil(len(points) / SAMPLE))
    near = flat_height[::step].abs() < distance
    require_table(where, int(near.sum()), distance)
    # Beyond the points that it is fitted to, the surface goes on level: parabolas would leave.
    scaled = []
    for along in flat:
        own = along[::step][near]
        lower, upper = own.min(), own.max()
        scaled.append(((along - lower) / ((upper - lower) / 2).clamp(min=distance) - 1).clamp(-1, 1))
    some = [along[::step] for along in scaled]
    height, weight = flat_height[::step], 1 / reach[::step]
    typical = float(reach[::step][near].median())
    least = LEAST_NOISE * distance / typical
    sigma = max(float((height.abs() * weight)[near].median()) * MAD, least)
    surface, clutter = plane.new_zeros(6), 0.0
    for _ in range(ROUNDS):
        surface = _fitted([along[near] for along in some], height[near], weight[near] / sigma, distance)
        off = (height - _on(surface, some)) * weight
        before = sigma
        middle, clutter = own_spread(off, sigma)
        sigma = max(middle * MAD, least)
        near = off.abs() < OWN * sigma
        if abs(sigma - before) < 1e-3 * sigma or int(near.sum()) < 3:
            break
    return SurfaceFit(flat_height - _on(surface, scaled), sigma, typical, clutter)


def require_table(where: str, num_near: int, distance: float) -> None:
    """Require that some points are near the plane that a surface is to be fitted over."""
    if num_near < 3:
        raise NoPlaneError(
            f"table_surface: {where}: the plane has {num_near} points nearer than distance={distance:g}; is it in the "
            "coordinates of the cloud?"
        )


def own_spread(off: Tensor, sigma: float) -> tuple[float, float]:
    """Return the median distance of a surface's own points from it, and the share of clutter within 2.5 ``sigma``.

    Of a normal distribution on even clutter the former times 1.4826, taken for ``sigma`` again and again, settles at
    its deviation: from above because clutter is left out, from below because so is too much of a wide peak's flanks.
    """
    first, last = (times * sigma for times in BESIDE)
    above, below = (int(((side > first) & (side < last)).sum()) for side in (off, -off))
    # Their geometric mean: what lies on one side only stands on the surface, or is another one beside it.
    density = 2 * math.sqrt(above * below) / (last - first)
    near = off.abs()
    near = near[near < OWN * sigma].sort().values
    count = len(near)
    if count == 0:
        return 0.0, 1.0
    own = count - density * OWN * sigma
    if own < 1:
        return sigma, 1.0
    without = torch.arange(1, count + 1, dtype=torch.float64, device=near.device) - density * near
    reached = (without >= own / 2).nonzero()
    return float(near[reached[0, 0]]), 1 - own / count


def _fitted(flat: list[Tensor], height: Tensor, weight: Tensor, distance: float) -> Tensor:
    """Return the six coefficients of the surface that fits weighted heights best.

    A bend of one distance over half the table's length is as likely as not; level and slopes are as good as free.
    """
    terms = [weight, *(term * weight for term in _terms(flat))]
    target = height * weight
    products = target.new_zeros(len(terms), len(terms))
    for i, one in enumerate(terms):
        for j, other in enumerate(terms[: i + 1]):
            products[i, j] = products[j, i] = (one * other).sum()
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
