"""Features of clouds at other places."""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.contracts.dispatch import op
from pcdata.contracts.numbers import checked_count
from pcdata.functional.neighbor_rows import nearest_rows


@op(
    points="N D",
    features="N C : float",
    ptr="ptr N B >= 1",
    queries="Q D",
    queries_ptr="ptr Q B",
    k=checked_count,
    steps=(nearest_rows,),
)
def interpolate_features(
    points: Tensor,  # (N, D) float32
    features: Tensor,  # (N, C) float
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    queries: Tensor,  # (Q, D) float32
    queries_ptr: Tensor | None = None,  # (B+1,); None = one cloud
    k: int = 3,
    backend: str = "auto",
) -> Tensor:  # (Q, C) in the dtype of the features
    """Average the features of the k nearest points of its own cloud at every query, weighted by 1 / distance^2.

    A query on a point has the features of that point, or the mean of those on it. A cloud with fewer than k points
    gives all it has. Gradients flow to the features; which points are near, and how near, is a decision. Labels take
    those of the nearest point: ``labels[knn(points, queries=queries, k=1)[0][:, 0]]``.

    Args:
        points: where the features are known, in any unit of length.
        features: one row for every point.
        ptr: row pointers of the points.
        queries: where they are wanted.
        queries_ptr: row pointers of the queries: query cloud b looks into point cloud b.
        k: neighbors per query.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        TooFewPointsError: a cloud of no points.
        ShapeError, DTypeError, DeviceError, NonFiniteError: an argument breaks the contract above.
        ConfigError: k is less than 1.

    Source: Shepard, A two-dimensional interpolation function for irregularly-spaced data, ACM 1968; Qi et al.,
    PointNet++, NeurIPS 2017.
    """
    assert ptr is not None  # @op fills it
    index, distance = nearest_rows(
        points.detach(), ptr, k, queries=queries.detach(), queries_ptr=queries_ptr, backend=backend
    )
    found, apart = index < len(points), distance.double()
    on_a_point = (apart == 0).any(1, keepdim=True)
    # Relative to the nearest, so that no distance is too small or too large to be squared.
    nearest = torch.where(on_a_point, 1.0, apart[:, :1])
    weight = torch.where(on_a_point, (apart == 0).double(), (nearest / torch.where(apart == 0, 1.0, apart)).square())
    weight = torch.where(found, weight, 0.0)
    weight = weight / weight.sum(1, keepdim=True)
    index = index.clamp(max=max(len(points) - 1, 0))
    total = features.new_zeros(len(queries), features.shape[1], dtype=torch.float64)
    for rows, share in zip(index.unbind(1), weight.unbind(1)):  # never (Q, k, C) numbers at once
        total = total + share[:, None] * features[rows].double()
    return total.to(features.dtype)
