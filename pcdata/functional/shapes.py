"""The sphere, cylinder, line or circle of each cloud that most of its points lie on.

A shape is found by random hypotheses and refined to the least squares of its own inliers, as planes are by
:func:`pcdata.functional.planes.ransac_plane`. All is float64; sums are taken in the order of the rows, so the answers
do not depend on the number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pcdata.contracts.dispatch import op
from pcdata.contracts.numbers import checked_count, checked_length
from pcdata.errors import ConfigError, DTypeError
from pcdata.functional.normals import estimate_normals
from pcdata.functional.plane_arguments import checked_seeds, checked_tilt, checked_up
from pcdata.functional.ransac import Limits, found_shapes
from pcdata.functional.rows import cloud_of_rows, segment_max, segment_min
from pcdata.geometry.shape_fit import CIRCLE, CYLINDER, LINE, ORIENTED_SPHERE, SPHERE, dot

_NEIGHBORS = 16  # whose plane gives the normals of a cylinder's points where none are given


class FoundSphere(NamedTuple):
    """The sphere of each cloud."""

    center: Tensor  # (B, 3) float64
    radius: Tensor  # (B,) float64
    inlier_mask: Tensor  # (N,) bool


class FoundLine(NamedTuple):
    """The line of each cloud, and how far its inliers reach."""

    center: Tensor  # (B, 3) float64, midway between the outer inliers
    direction: Tensor  # (B, 3) float64, unit
    length: Tensor  # (B,) float64, between the outer inliers
    inlier_mask: Tensor  # (N,) bool


class FoundCylinder(NamedTuple):
    """The cylinder of each cloud, and how far its inliers reach along the axis."""

    center: Tensor  # (B, 3) float64, on the axis, midway between the outer inliers
    axis: Tensor  # (B, 3) float64, unit
    radius: Tensor  # (B,) float64
    length: Tensor  # (B,) float64, between the outer inliers
    inlier_mask: Tensor  # (N,) bool


class FoundCircle(NamedTuple):
    """The circle of each cloud."""

    center: Tensor  # (B, 3) float64
    normal: Tensor  # (B, 3) float64, unit, of its plane
    radius: Tensor  # (B,) float64
    inlier_mask: Tensor  # (N,) bool


def checked_radii(where: str, name: str, arguments: Mapping[str, Any]) -> tuple[float, float]:
    """Require the least and the largest radius."""
    value = arguments[name]
    numbers = list(value) if isinstance(value, Sequence) and not isinstance(value, str) else []
    if len(numbers) != 2 or any(isinstance(one, bool) or not isinstance(one, (int, float)) for one in numbers):
        raise DTypeError(f"{where}: {name} must be the least and the largest radius, (low, high), got {value!r:.100}")
    low, high = float(numbers[0]), float(numbers[1])
    if not 0 <= low <= high or low == math.inf or high == 0:
        raise ConfigError(f"{where}: {name} must be (low, high) with 0 <= low <= high, got {(low, high)}")
    return low, high


@op(
    points="N 3",
    ptr="ptr N B >= 4",
    normals="N 3",
    distance=checked_length,
    num_hypotheses=checked_count,
    seed=checked_seeds,
    radius=checked_radii,
    gradient=False,
)
def ransac_sphere(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    normals: Tensor | None = None,  # (N, 3) float32, of any length and either sign
    distance: float = 0.01,
    num_hypotheses: int = 1000,
    seed: int | Sequence[int] | Tensor = 0,
    radius: tuple[float, float] | None = None,
    backend: str = "auto",
) -> FoundSphere:
    """Find each cloud's sphere with the most points nearer than ``distance`` to its surface.

    Hypotheses go through four distinct random points, or through two whose normals meet where normals are given: where
    few points are of the sphere, those find it in far fewer tries. They are compared on up to 4096 points of each
    cloud, drawn once; the best 16 of a larger cloud on all of its points; the earliest of equals wins. Then the sphere
    is refitted to its inliers by least squares of the distances until they no longer change (at most 20 rounds; a refit
    that loses half of them is not taken). ``inlier_mask`` is ``||p - center| - radius| < distance`` in float64.

    Args:
        points: the clouds, in any unit of length.
        ptr: row pointers.
        normals: of the surface at every point.
        distance: in the unit of the points.
        num_hypotheses: spheres to try.
        seed: of the draws; one for every cloud, so that a batch equals its clouds alone, or one per cloud.
        radius: least and largest; points of a plane lie on very large spheres.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        TooFewPointsError: a cloud has fewer than 4 points.
        NoShapeError: no hypothesis is a sphere within the limits, or too few points are near it.
        ConfigError: a parameter out of range.

    Source: Fischler & Bolles, CACM 24(6), 1981; with normals Schnabel et al., Efficient RANSAC, CGF 26(2), 2007.
    """
    assert ptr is not None  # @op fills it
    assert isinstance(seed, list)  # and makes it one per cloud
    family = SPHERE if normals is None else ORIENTED_SPHERE
    limits = Limits(radius, None, None)
    shapes, inliers = found_shapes(
        "ransac_sphere", family, points, ptr, normals, distance, num_hypotheses, seed, limits
    )
    return FoundSphere(shapes[:, :3], shapes[:, 3], inliers)


@op(
    points="N 3",
    ptr="ptr N B >= 3",
    normals="N 3",
    distance=checked_length,
    num_hypotheses=checked_count,
    seed=checked_seeds,
    radius=checked_radii,
    up=checked_up,
    max_tilt=checked_tilt,
    gradient=False,
)
def ransac_cylinder(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    normals: Tensor | None = None,  # (N, 3) float32, of any length and either sign
    distance: float = 0.01,
    num_hypotheses: int = 1000,
    seed: int | Sequence[int] | Tensor = 0,
    radius: tuple[float, float] | None = None,
    up: Tensor | Sequence[float] | None = None,
    max_tilt: float | None = None,
    backend: str = "auto",
) -> FoundCylinder:
    """Find each cloud's cylinder, without ends, with the most points nearer than ``distance`` to its surface.

    Hypotheses are the cylinders of two random points and their normals, which its axis is at right angles to. They are
    compared and refined as those of :func:`ransac_sphere`. The axis points along ``up`` when given, else its largest
    component is positive.

    Args:
        points: the clouds, in any unit of length.
        ptr: row pointers.
        normals: of the surface at every point; None = those of its 16 nearest points.
        distance: in the unit of the points.
        num_hypotheses: cylinders to try.
        seed: of the draws; one for every cloud, so that a batch equals its clouds alone, or one per cloud.
        radius: least and largest.
        up: a direction, (3,) or one per cloud (B, 3); any length.
        max_tilt: radians; only cylinders whose axis is within this angle of up or -up compete.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        TooFewPointsError: a cloud has fewer than 3 points.
        NoShapeError: no hypothesis is a cylinder within the limits, or too few points are near it.
        ConfigError: a parameter out of range, or ``max_tilt`` without ``up``.

    Source: Schnabel et al., Efficient RANSAC for point-cloud shape detection, CGF 26(2), 2007.
    """
    assert ptr is not None  # @op fills it
    assert isinstance(seed, list)  # and makes it one per cloud,
    assert up is None or isinstance(up, Tensor)  # and unit vectors
    if normals is None:
        normals = estimate_normals(points, ptr, radius=None, max_neighbors=_NEIGHBORS)
    limits = Limits(radius, up, max_tilt)
    shapes, inliers = found_shapes(
        "ransac_cylinder", CYLINDER, points, ptr, normals, distance, num_hypotheses, seed, limits
    )
    center, axis, length = _ends(points, ptr, shapes, inliers, up)
    return FoundCylinder(center, axis, shapes[:, 6], length, inliers)


@op(
    points="N 3",
    ptr="ptr N B >= 2",
    distance=checked_length,
    num_hypotheses=checked_count,
    seed=checked_seeds,
    up=checked_up,
    max_tilt=checked_tilt,
    gradient=False,
)
def ransac_line(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    distance: float = 0.01,
    num_hypotheses: int = 1000,
    seed: int | Sequence[int] | Tensor = 0,
    up: Tensor | Sequence[float] | None = None,
    max_tilt: float | None = None,
    backend: str = "auto",
) -> FoundLine:
    """Find each cloud's line, without ends, with the most points nearer than ``distance``.

    Hypotheses go through two random points; they are compared and refined as those of :func:`ransac_sphere`. The
    direction points along ``up`` when given, else its largest component is positive.

    Args:
        points: the clouds, in any unit of length.
        ptr: row pointers.
        distance: in the unit of the points.
        num_hypotheses: lines to try.
        seed: of the draws; one for every cloud, so that a batch equals its clouds alone, or one per cloud.
        up: a direction, (3,) or one per cloud (B, 3); any length.
        max_tilt: radians; only lines within this angle of up or -up compete.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        TooFewPointsError: a cloud has fewer than 2 points.
        NoShapeError: no hypothesis is a line within the limits (all points drawn are one).
        ConfigError: a parameter out of range, or ``max_tilt`` without ``up``.

    Source: Fischler & Bolles, CACM 24(6), 1981.
    """
    assert ptr is not None  # @op fills it
    assert isinstance(seed, list)  # and makes it one per cloud,
    assert up is None or isinstance(up, Tensor)  # and unit vectors
    limits = Limits(None, up, max_tilt)
    shapes, inliers = found_shapes("ransac_line", LINE, points, ptr, None, distance, num_hypotheses, seed, limits)
    center, direction, length = _ends(points, ptr, shapes, inliers, up)
    return FoundLine(center, direction, length, inliers)


@op(
    points="N 3",
    ptr="ptr N B >= 3",
    distance=checked_length,
    num_hypotheses=checked_count,
    seed=checked_seeds,
    radius=checked_radii,
    up=checked_up,
    max_tilt=checked_tilt,
    gradient=False,
)
def ransac_circle(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    distance: float = 0.01,
    num_hypotheses: int = 1000,
    seed: int | Sequence[int] | Tensor = 0,
    radius: tuple[float, float] | None = None,
    up: Tensor | Sequence[float] | None = None,
    max_tilt: float | None = None,
    backend: str = "auto",
) -> FoundCircle:
    """Find each cloud's circle in space with the most points nearer than ``distance`` to its rim.

    Hypotheses go through three random points; they are compared and refined as those of :func:`ransac_sphere`. The
    normal points along ``up`` when given, else its largest component is positive. For circles in a plane give points
    whose third coordinate is 0.

    Args:
        points: the clouds, in any unit of length.
        ptr: row pointers.
        distance: in the unit of the points.
        num_hypotheses: circles to try.
        seed: of the draws; one for every cloud, so that a batch equals its clouds alone, or one per cloud.
        radius: least and largest.
        up: a direction, (3,) or one per cloud (B, 3); any length.
        max_tilt: radians; only circles whose normal is within this angle of up or -up compete.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        TooFewPointsError: a cloud has fewer than 3 points.
        NoShapeError: no hypothesis is a circle within the limits, or too few points are near it.
        ConfigError: a parameter out of range, or ``max_tilt`` without ``up``.

    Source: Fischler & Bolles, CACM 24(6), 1981.
    """
    assert ptr is not None  # @op fills it
    assert isinstance(seed, list)  # and makes it one per cloud,
    assert up is None or isinstance(up, Tensor)  # and unit vectors
    limits = Limits(radius, up, max_tilt)
    shapes, inliers = found_shapes("ransac_circle", CIRCLE, points, ptr, None, distance, num_hypotheses, seed, limits)
    return FoundCircle(shapes[:, :3], _faced(shapes[:, 3:6], up), shapes[:, 6], inliers)


def _faced(directions: Tensor, up: Tensor | None) -> Tensor:
    """Turn directions (B, 3) along up, else so that the largest component is positive."""
    largest = directions.gather(1, directions.abs().argmax(1, keepdim=True)).squeeze(1)
    along = torch.zeros_like(largest) if up is None else dot(directions, up.to(directions.device))
    return torch.where((torch.where(along == 0, largest, along) < 0)[:, None], -directions, directions)


def _ends(
    points: Tensor, ptr: Tensor, shapes: Tensor, inliers: Tensor, up: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the middle (B, 3) of the inliers along each axis, the axis (B, 3) and their length along it (B,)."""
    axis, cloud = _faced(shapes[:, 3:6], up), cloud_of_rows(ptr)
    along = dot(points.double() - shapes[cloud, :3], axis[cloud])
    low = segment_min(torch.where(inliers, along, torch.inf), ptr)
    high = segment_max(torch.where(inliers, along, -torch.inf), ptr)
    return shapes[:, :3] + ((low + high) / 2)[:, None] * axis, axis, high - low
