"""Surface normals from the covariance of the nearest points, without a batched eigensolver.

Source: Hoppe et al., Surface reconstruction from unorganized points, 1992; the neighborhood and the fallback are those
of Open3D's ``estimate_normals`` with ``KDTreeSearchParamHybrid``, without a radius with ``KDTreeSearchParamKNN``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.compiling import is_traced
from pcdata.contracts.dispatch import inner, op
from pcdata.contracts.host import all_finite
from pcdata.contracts.known import FINITE, is_known, note
from pcdata.contracts.numbers import checked_count, checked_length
from pcdata.contracts.operators import Traced
from pcdata.errors import DeviceError, DTypeError, NonFiniteError, ShapeError
from pcdata.functional.image_grid import ImageGrid, checked_grid
from pcdata.functional.nearest import nearest_chunks


def checked_reach(where: str, name: str, arguments: Mapping[str, Any]) -> float | None:
    """Require a positive, finite length, or None: however far."""
    return None if arguments[name] is None else checked_length(where, name, arguments)


@op(
    points="N 3",
    ptr="ptr N B",
    radius=checked_reach,
    max_neighbors=checked_count,
    grid=checked_grid,
    steps=(nearest_chunks,),
    gradient=False,
    traced=Traced(
        "Tensor points, Tensor? ptr, float? radius, int max_neighbors",
        "Tensor normals",
        lambda points, **_: points.new_empty(points.shape),
    ),
)
def estimate_normals(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    radius: float | None = 0.02,
    max_neighbors: int = 30,
    grid: ImageGrid | None = None,
    backend: str = "auto",
) -> Tensor:  # (N, 3) float32, unit length
    """Estimate each point's normal: the direction in which its neighborhood varies least.

    The neighborhood is the nearest ``max_neighbors`` points with d < radius, the point itself included; its covariance
    and eigenvectors are float64. Where no direction stands out, one is agreed on: fewer than three neighbors, or an
    equal spread in all directions, give (0, 0, 1); neighbors on a line along d, or spread equally across d, give the
    direction across d and across (0, d_z, -d_y), or across d and (-d_z, 0, d_x) where d_x is larger than d_y. The sign
    is a convention: the last component of (x, y, z) that is not 0 is positive, so z >= 0; use :func:`orient_normals`
    to face the camera.

    Args:
        points: the clouds, in any unit of length.
        ptr: row pointers of the points.
        radius: in the unit of the points; None = the nearest, however far.
        max_neighbors: nearest points used at most.
        grid: the depth image the points still lie on; same answers, lets kernels search pixel windows.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError: an argument breaks the contract above.
        ConfigError: the radius is not a positive length, or max_neighbors is less than 1.
    """
    assert ptr is not None  # @op fills it
    normals = torch.empty_like(points)
    wide = points.double()
    for query, squared, nearest in nearest_chunks(points, ptr, max_neighbors, radius=radius, backend=backend):
        found = squared.isfinite()
        count = found.sum(1)
        # A missing neighbor points at the query itself: offset 0 adds nothing to the sums below.
        index = torch.where(found, nearest, query[:, None])
        # Offsets from the query keep all digits however far the cloud lies from the origin.
        offset = wide[index] - wide[query][:, None]
        normal = smallest_eigenvector(*covariance(offset, count))
        normal = torch.where((count < 3)[:, None], _up(normal), normal)
        normals[query] = _positive_last(normal).float()
    return normals


def orient_normals(
    points: Tensor,  # (N, 3) float32
    normals: Tensor,  # (N, 3) float32
    viewpoint: Tensor,  # (N, 3) per point, or (3,) or (1, 3) for all; same frame as the points
) -> Tensor:  # (N, 3) float32
    """Flip each normal that faces away from the viewpoint: normal . (viewpoint - point) < 0, in float64.

    A normal seen exactly edge-on (product 0) is kept as it is.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError: an argument breaks the contract above.
    """
    check_viewpoint(points, normals, viewpoint)
    turned = _turned if is_traced() else facing_normals  # a compiler knows what to do with the plain one
    return turned(points, normals, viewpoint)


@inner
def normals_facing(
    points: Tensor,
    ptr: Tensor,
    radius: float | None,
    max_neighbors: int,
    grid: ImageGrid | None,
    viewpoint: Tensor,  # as orient_normals takes it
) -> Tensor:
    """Estimate normals and turn them to the viewpoint; raises what :func:`estimate_normals` and the other raise."""
    normals = estimate_normals(points, ptr, radius=radius, max_neighbors=max_neighbors, grid=grid)
    note(FINITE, normals)  # those of finite points are
    return orient_normals(points, normals, viewpoint)


@inner
def facing_normals(points: Tensor, normals: Tensor, viewpoint: Tensor) -> Tensor:
    """Run the body of :func:`orient_normals`."""
    return _turned(points, normals, viewpoint)


def _turned(points: Tensor, normals: Tensor, viewpoint: Tensor) -> Tensor:
    """Turn normals that face away; the product is (x + y) + z."""
    x, y, z = (normals.double() * (viewpoint.double() - points.double())).unbind(-1)
    return torch.where(((x + y) + z < 0)[:, None], -normals, normals)


def check_viewpoint(points: Tensor, normals: Tensor, viewpoint: Tensor) -> None:
    """Require what :func:`orient_normals` does."""
    where = "orient_normals"
    for name, value in (("points", points), ("normals", normals), ("viewpoint", viewpoint)):
        if not isinstance(value, Tensor) or not value.dtype.is_floating_point:
            raise DTypeError(f"{where}: {name} must be a float tensor, not {getattr(value, 'dtype', type(value))}")
        if value.device != points.device:
            raise DeviceError(f"{where}: {name} is on {value.device} but points is on {points.device}")
        if not is_known(FINITE, value) and not all_finite(value):
            raise NonFiniteError(f"{where}: {name} has NaN or infinite values; drop those points first")
    if points.ndim != 2 or points.shape[1] != 3 or normals.shape != points.shape:
        raise ShapeError(
            f"{where}: points and normals must both be (N, 3), got {tuple(points.shape)} and {tuple(normals.shape)}"
        )
    if tuple(viewpoint.shape) not in {(3,), (1, 3), tuple(points.shape)}:
        raise ShapeError(
            f"{where}: viewpoint must be (3,), (1, 3) or one per point {tuple(points.shape)}, "
            f"got {tuple(viewpoint.shape)}"
        )


# Differences of covariances (scaled to entries of at most 1) and of unit vectors that are rounding, not shape.
_ROUND = 1e-12

Symmetric = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]  # xx, xy, xz, yy, yz, zz, each (m,) float64


def covariance(offset: Tensor, count: Tensor) -> Symmetric:
    """Return the covariances of (m, k, 3) offsets, of which ``count`` (m,) are neighbors and the rest 0."""
    number = count.clamp(min=1).double()
    x, y, z = offset.unbind(-1)
    mean_x, mean_y, mean_z = (axis.sum(1) / number for axis in (x, y, z))
    xx = (x * x).sum(1) / number - mean_x * mean_x
    xy = (x * y).sum(1) / number - mean_x * mean_y
    xz = (x * z).sum(1) / number - mean_x * mean_z
    yy = (y * y).sum(1) / number - mean_y * mean_y
    yz = (y * z).sum(1) / number - mean_y * mean_z
    zz = (z * z).sum(1) / number - mean_z * mean_z
    return xx, xy, xz, yy, yz, zz


def smallest_eigenvector(xx: Tensor, xy: Tensor, xz: Tensor, yy: Tensor, yz: Tensor, zz: Tensor) -> Tensor:
    """Return the (m, 3) unit eigenvectors of the smallest eigenvalues of symmetric 3x3 matrices, in closed form.

    The eigenvalue that stands clear of the other two gives its vector by a cross product. Where that is the largest,
    the smallest is found in the plane across it, as a 2x2 problem. A multiple of the identity gives (0, 0, 1).

    Source: Eberly, A robust eigensolver for 3x3 symmetric matrices, Geometric Tools, 2014-2023, the non-iterative
    algorithm; its second step is replaced by a rotation angle, which keeps all digits for points nearly on a line.
    """
    scale = torch.stack([xx, xy, xz, yy, yz, zz]).abs().amax(0)
    safe = torch.where(scale > 0, scale, 1.0)
    matrix = xx, xy, xz, yy, yz, zz = xx / safe, xy / safe, xz / safe, yy / safe, yz / safe, zz / safe
    mean = (xx + yy + zz) / 3
    dx, dy, dz = xx - mean, yy - mean, zz - mean
    spread = ((dx * dx + dy * dy + dz * dz + 2 * (xy * xy + xz * xz + yz * yz)) / 6).sqrt()
    is_isotropic = spread <= _ROUND
    safe = torch.where(is_isotropic, 1.0, spread)
    determinant = dx * (dy * dz - yz * yz) - xy * (xy * dz - yz * xz) + xz * (xy * yz - dy * xz)
    half = (determinant / (safe * safe * safe) / 2).clamp(-1.0, 1.0)
    angle = half.acos() / 3
    largest = mean + spread * 2 * angle.cos()
    smallest = mean + spread * 2 * (angle + 2 * math.pi / 3).cos()

    clear_is_largest = half >= 0
    clear = _separate_eigenvector(matrix, torch.where(clear_is_largest, largest, smallest))
    normal = torch.where(clear_is_largest[:, None], _smallest_across(matrix, clear), clear)
    return torch.where(is_isotropic[:, None], _up(normal), normal)


def _up(like: Tensor) -> Tensor:
    """Return (0, 0, 1)."""
    return torch.eye(3, dtype=like.dtype, device=like.device)[2]


def _separate_eigenvector(matrix: Symmetric, value: Tensor) -> Tensor:
    """Return the unit eigenvector of a simple eigenvalue: the longest cross product of two rows of A - value."""
    xx, xy, xz, yy, yz, zz = matrix
    rows = [
        torch.stack([xx - value, xy, xz], -1),
        torch.stack([xy, yy - value, yz], -1),
        torch.stack([xz, yz, zz - value], -1),
    ]
    products = torch.stack([torch.linalg.cross(rows[i], rows[j]) for i, j in ((0, 1), (0, 2), (1, 2))], 1)
    longest = products.square().sum(-1).argmax(1)
    return _unit(products[torch.arange(len(longest), dtype=torch.int64, device=longest.device), longest])


def _smallest_across(matrix: Symmetric, clear: Tensor) -> Tensor:
    """Return the unit vector across ``clear`` (m, 3) along which the matrix is smallest."""
    u = _perpendicular(clear)
    v = torch.linalg.cross(clear, u)
    along_u, along_v = _times(matrix, u), _times(matrix, v)
    uu, uv, vv = (u * along_u).sum(-1), (u * along_v).sum(-1), (v * along_v).sum(-1)
    p, q = uu - vv, 2 * uv
    round_ = torch.hypot(p, q) <= _ROUND
    angle = torch.where(round_, 0.0, torch.atan2(q, p) / 2)  # from u to the larger axis of [[uu, uv], [uv, vv]]
    return angle.cos()[:, None] * v - angle.sin()[:, None] * u


def _perpendicular(direction: Tensor) -> Tensor:
    """Return (m, 3) unit vectors across unit vectors, from the two components that cannot both vanish."""
    x, y, z = direction.unbind(-1)
    zero = torch.zeros_like(x)
    use_x = (x.abs() > y.abs() + _ROUND)[:, None]
    return _unit(torch.where(use_x, torch.stack([-z, zero, x], -1), torch.stack([zero, z, -y], -1)))


def _times(matrix: Symmetric, vector: Tensor) -> Tensor:
    xx, xy, xz, yy, yz, zz = matrix
    x, y, z = vector.unbind(-1)
    return torch.stack([xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z], -1)


def _unit(vector: Tensor) -> Tensor:
    length = vector.square().sum(-1, keepdim=True).sqrt()
    return vector / torch.where(length > 0, length, 1.0)


def _positive_last(normal: Tensor) -> Tensor:
    """Turn each (m, 3) vector so that its last component that is not 0 is positive."""
    x, y, z = normal.unbind(-1)
    leading = torch.where(z != 0, z, torch.where(y != 0, y, x))
    # Adding 0 turns -0 into 0, so equal directions have equal bits.
    return torch.where((leading < 0)[:, None], -normal, normal) + 0.0
