"""The shape of the surface around each point: covariances of neighborhoods, and the features that are made of them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner, op
from pcdata.contracts.numbers import checked_count
from pcdata.contracts.tensors import check_tensors
from pcdata.errors import ConfigError, near_matches
from pcdata.functional.image_grid import ImageGrid, checked_grid
from pcdata.functional.neighbor_rows import nearest_rows
from pcdata.functional.neighbors import checked_radius, finder

_ROWS = 1 << 21  # neighbors whose offsets are alive at once
_ENTRIES = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # of a symmetric matrix
_OF_MATRIX = [0, 1, 2, 1, 3, 4, 2, 4, 5]  # where each entry of the matrix lies among them


@op(
    points="N 3",
    ptr="ptr N B",
    queries="Q 3",
    queries_ptr="ptr Q B",
    radius=checked_radius,
    max_neighbors=checked_count,
    grid=checked_grid,
    steps=(nearest_rows,),
)
def neighborhood_covariance(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    max_neighbors: int = 30,
    radius: float | Tensor | None = None,  # or (Q,) float
    queries: Tensor | None = None,  # (Q, 3) float32; None = the points themselves
    queries_ptr: Tensor | None = None,  # (B+1,); None = one cloud
    grid: ImageGrid | None = None,
    backend: str = "auto",
) -> tuple[Tensor, Tensor, Tensor]:  # mean (Q, 3) float32, covariance (Q, 3, 3) float64, count (Q,) int64
    """Return the mean and the covariance of the neighbors of every query: the nearest ``max_neighbors``, d < radius.

    The covariance is that of the population (the sum over the count), so its eigenvectors are the principal axes of
    the neighborhood and its eigenvalues the variances along them: ``torch.linalg.eigh(covariance)``. Fewer than three
    neighbors span no plane, and no neighbor gives zeros: look at ``count``. Both carry gradients to the points; which
    points are neighbors is a decision.

    Args:
        points: the clouds, in any unit of length.
        ptr: row pointers of the points.
        max_neighbors: nearest points used at most, the point itself among them where the queries are the points.
        radius: in the unit of the points, one or one per query; None = the nearest, however far.
        queries: where to look.
        queries_ptr: row pointers of the queries: query cloud b looks into point cloud b.
        grid: the depth image the points still lie on; same answers, lets kernels search pixel windows.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError: an argument breaks the contract above.
        ConfigError: the radius is not a positive length, or max_neighbors is less than 1.
    """
    assert ptr is not None  # @op fills it
    own = {} if queries is None else {"queries": queries.detach(), "queries_ptr": queries_ptr}
    index, _ = finder(points, ptr, grid, backend)(max_neighbors, **own, radius=radius)
    centers = (points if queries is None else queries).detach()
    carries = torch.is_grad_enabled() and points.requires_grad
    return neighborhood_shapes(points, index, centers, backend="torch" if carries else backend)


@inner
def neighborhood_shapes(
    points: Tensor,  # (N, 3) float32
    index: Tensor,  # (Q, K) int64 neighbors; N = missing, and those come last
    centers: Tensor,  # (Q, 3) float32
    *,
    backend: str = "auto",
) -> tuple[Tensor, Tensor, Tensor]:  # mean (Q, 3) float32, covariance (Q, 3, 3) float64, count (Q,) int64
    """Return mean and covariance of neighbors that were found; sums are in float64, in their order."""
    wide = torch.cat([points.double(), points.new_zeros(1, 3, dtype=torch.float64)])
    count = (index < len(points)).sum(1)
    at_once = max(1, _ROWS // max(1, index.shape[1]))
    parts = []
    for rows, center in zip(index.split(at_once), centers.double().split(at_once)):
        found = rows < len(points)
        # Offsets from the query keep all digits however far the cloud lies from the origin.
        offset = torch.where(found[..., None], wide[rows] - center[:, None], 0.0)
        number = found.sum(1).clamp(min=1)[:, None]
        mean = _summed(offset) / number
        offset = torch.where(found[..., None], offset - mean[:, None], 0.0)
        square = _summed(torch.stack([offset[..., i] * offset[..., j] for i, j in _ENTRIES], dim=-1)) / number
        parts.append((torch.where(found.any(1)[:, None], center + mean, 0.0).float(), square[:, _OF_MATRIX]))
    if not parts:
        return centers.float(), centers.new_zeros(0, 3, 3, dtype=torch.float64), count
    mean, square = (torch.cat(values) for values in zip(*parts))
    return mean, square.reshape(-1, 3, 3), count


def _summed(values: Tensor) -> Tensor:
    """Sum (Q, K, ...) over K one after another: the same bits on every backend."""
    total, *others = values.unbind(1)
    for other in others:
        total = total + other
    return total


# Name -> what it is of the eigenvalues a >= b >= c. Weinmann et al., ISPRS Journal 105, 2015; surface variation: Pauly
# et al., Visualization 2002, which PCL calls curvature.
SHAPE_FEATURES: dict[str, Callable[[Tensor, Tensor, Tensor], Tensor]] = {
    "linearity": lambda a, b, c: (a - b) / a,
    "planarity": lambda a, b, c: (b - c) / a,
    "sphericity": lambda a, b, c: c / a,
    "anisotropy": lambda a, b, c: (a - c) / a,
    "surface_variation": lambda a, b, c: c / (a + b + c),
    "omnivariance": lambda a, b, c: (a * b * c) ** (1 / 3),
    "eigenentropy": lambda a, b, c: _entropy(torch.stack([a, b, c]) / (a + b + c)),
    "eigenvalue_sum": lambda a, b, c: a + b + c,
}


def _entropy(shares: Tensor) -> Tensor:
    return -(shares * shares.log()).sum(0)


def shape_features(
    covariance: Tensor,  # (Q, 3, 3) float, as neighborhood_covariance returns it
    *names: str,
) -> dict[str, Tensor]:  # name -> (Q,) in the dtype of the covariance
    """Describe neighborhoods by the eigenvalues a >= b >= c of their covariances; all of them where none is named.

    ``linearity`` (a-b)/a, ``planarity`` (b-c)/a, ``sphericity`` c/a, ``anisotropy`` (a-c)/a, ``surface_variation``
    c/(a+b+c) (PCL's curvature, 0 on a plane, 1/3 without any direction), ``omnivariance`` (abc)^(1/3),
    ``eigenentropy`` of the eigenvalues over their sum, ``eigenvalue_sum`` a+b+c (the last of the points' unit squared,
    omnivariance too). A neighborhood without extent is 0 in all. Carries gradients to the covariances.

    Raises:
        ConfigError: an unknown name.
        ShapeError, DTypeError, NonFiniteError: the covariances are not such.

    Source: Weinmann et al., Semantic point cloud interpretation based on optimal neighborhoods, relevant features and
    efficient classifiers, ISPRS Journal of Photogrammetry and Remote Sensing 105, 2015.
    """
    check_tensors("shape_features", {"covariance": covariance}, {"covariance": "Q 3 3 : float"})
    for name in names:
        if name not in SHAPE_FEATURES:
            raise ConfigError(
                f"shape_features: unknown feature {name!r}; there are {', '.join(SHAPE_FEATURES)}"
                f"{near_matches(name, SHAPE_FEATURES)}"
            )
    values = torch.linalg.eigvalsh(covariance)
    # Rounding leaves eigenvalues of flat neighborhoods just below 0; a floor also keeps logarithms and roots finite.
    floor = torch.finfo(covariance.dtype).tiny
    c, b, a = values.clamp(min=floor**0.25).unbind(1)
    has_extent = values[:, 2] > floor**0.25
    return {name: torch.where(has_extent, SHAPE_FEATURES[name](a, b, c), 0.0) for name in names or SHAPE_FEATURES}
