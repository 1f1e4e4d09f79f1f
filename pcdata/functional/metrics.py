"""How far two clouds are apart: Chamfer and Hausdorff distance, F-score."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from pcdata.contracts.dispatch import op
from pcdata.contracts.numbers import checked_length, checked_word
from pcdata.errors import ShapeError
from pcdata.functional.nearest import squared_distance
from pcdata.functional.neighbor_rows import nearest_rows, rows_within
from pcdata.functional.neighbors import finder
from pcdata.functional.norms import norm_length
from pcdata.functional.rows import cloud_of_rows, count_per_cloud, counts_from_ptr, segment_max

SIDES = ("both", "a_to_b", "b_to_a")
NORMS = ("l2", "l1")


@op(
    points_a="N 3",
    ptr_a="ptr N B >= 1",
    points_b="M 3",
    ptr_b="ptr M B >= 1",
    normals_a="N 3",
    normals_b="M 3",
    sides=partial(checked_word, words=SIDES),
    norm=partial(checked_word, words=NORMS),
    steps=(nearest_rows, rows_within),
)
def chamfer_distance(
    points_a: Tensor,  # (N, 3) float32
    ptr_a: Tensor | None,  # (B+1,); None = one cloud
    points_b: Tensor,  # (M, 3) float32
    ptr_b: Tensor | None,  # (B+1,); None = one cloud
    *,
    squared: bool = True,
    sides: str = "both",
    norm: str = "l2",
    normals_a: Tensor | None = None,  # (N, 3) float32, unit length
    normals_b: Tensor | None = None,  # (M, 3) float32, unit length
    abs_cosine: bool = True,
    backend: str = "auto",
) -> Tensor:  # (B,) float32; with normals (B, 2): the distance, and the mean of 1 - |cosine|
    """Measure the distance between two clouds: mean over a to the nearest of b, plus mean over b to the nearest of a.

    Squared distances by default, in the points' unit squared, as in PyTorch3D's ``chamfer_distance``; with
    ``squared=False`` plain distances. With ``norm="l1"`` distances are |dx| + |dy| + |dz|, of the point that is nearest
    by them. Means are taken in float64. The result carries gradients to both clouds and their normals; at distance 0
    the gradient of the plain distance is taken as 0.

    Args:
        points_a: the clouds to measure from.
        ptr_a: row pointers.
        points_b: the clouds to measure to.
        ptr_b: row pointers.
        squared: square the distances.
        sides: which of the two means: "both", "a_to_b" (how far a is from b: accuracy), or "b_to_a" (completeness).
        norm: "l2", or "l1".
        normals_a: also compare the normals of nearest points over the same sides.
        normals_b: those of the others; both or neither.
        abs_cosine: normals of either sign are alike; False: the mean of 1 - cosine, 2 where they are opposite.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        TooFewPointsError: a cloud is empty; the message names it.
        ShapeError: normals of one side alone.
        ShapeError, DTypeError, DeviceError, NonFiniteError: an argument breaks the contract above.
        ConfigError: an unknown side or norm.

    Source: Barrow et al., Parametric correspondence and chamfer matching, IJCAI 1977.
    """
    assert ptr_a is not None  # @op fills both
    assert ptr_b is not None
    if (normals_a is None) != (normals_b is None):
        raise ShapeError("chamfer_distance: give the normals of both clouds, or of neither")
    ways = [
        (points_a, ptr_a, normals_a, points_b, ptr_b, normals_b),
        (points_b, ptr_b, normals_b, points_a, ptr_a, normals_a),
    ]
    total, turned = None, None
    for queries, queries_ptr, normals, points, ptr, other_normals in ways[sides == "b_to_a" : 2 - (sides == "a_to_b")]:
        nearest, distance = _to_nearest(queries, queries_ptr, points, ptr, squared, norm, backend)
        own = mean_per_cloud(distance, queries_ptr)
        total = own if total is None else total + own
        if normals is not None and other_normals is not None:
            cosine = (normals * other_normals[nearest]).sum(1)
            own = mean_per_cloud(1 - (cosine.abs() if abs_cosine else cosine), queries_ptr)
            turned = own if turned is None else turned + own
    assert total is not None
    return total.float() if turned is None else torch.stack([total, turned], dim=1).float()


@op(points_a="N D", ptr_a="ptr N B >= 1", points_b="M D", ptr_b="ptr M B >= 1", steps=(nearest_rows,))
def hausdorff_distance(
    points_a: Tensor,  # (N, D) float32
    ptr_a: Tensor | None,  # (B+1,); None = one cloud
    points_b: Tensor,  # (M, D) float32
    ptr_b: Tensor | None,  # (B+1,); None = one cloud
    *,
    backend: str = "auto",
) -> Tensor:  # (B, 2) float32: from a to b, from b to a
    """Return how far the point farthest from the other cloud is, each way; the larger is the Hausdorff distance.

    In the points' unit, of three columns or any other number. The result carries gradients to the two points that
    decide it.

    Raises:
        TooFewPointsError: a cloud is empty; the message names it.
        ShapeError, DTypeError, DeviceError, NonFiniteError: an argument breaks the contract above.

    Source: Huttenlocher et al., Comparing images using the Hausdorff distance, IEEE TPAMI 15(9), 1993.
    """
    assert ptr_a is not None  # @op fills both
    assert ptr_b is not None
    _, forth = _to_nearest(points_a, ptr_a, points_b, ptr_b, False, "l2", backend)
    _, back = _to_nearest(points_b, ptr_b, points_a, ptr_a, False, "l2", backend)
    return torch.stack([segment_max(forth, ptr_a), segment_max(back, ptr_b)], dim=1)


@op(
    points_a="N D",
    ptr_a="ptr N B >= 1",
    points_b="M D",
    ptr_b="ptr M B >= 1",
    threshold=checked_length,
    steps=(nearest_rows,),
    gradient=False,
)
def f_score(
    points_a: Tensor,  # (N, D) float32
    ptr_a: Tensor | None,  # (B+1,); None = one cloud
    points_b: Tensor,  # (M, D) float32
    ptr_b: Tensor | None,  # (B+1,); None = one cloud
    *,
    threshold: float,
    backend: str = "auto",
) -> Tensor:  # (B, 3) float32: F-score, precision, recall
    """Compare a reconstruction a with the truth b: parts of the points that lie closer than a threshold to the other.

    Precision is the part of a within the threshold of b, recall the part of b within it of a, the F-score their
    harmonic mean, 0 where both are 0. The test is d < threshold, in float32.

    Raises:
        TooFewPointsError: a cloud is empty; the message names it.
        ConfigError: the threshold is no positive length.
        ShapeError, DTypeError, DeviceError, NonFiniteError: an argument breaks the contract above.

    Source: Knapitsch et al., Tanks and Temples: Benchmarking large-scale scene reconstruction, ACM TOG 36(4), 2017.
    """
    assert ptr_a is not None  # @op fills both
    assert ptr_b is not None
    parts = []
    for queries, queries_ptr, points, ptr in ((points_a, ptr_a, points_b, ptr_b), (points_b, ptr_b, points_a, ptr_a)):
        _, distance = _to_nearest(queries, queries_ptr, points, ptr, False, "l2", backend)
        near = count_per_cloud(distance < threshold, queries_ptr)
        parts.append(near.double() / counts_from_ptr(queries_ptr))
    precision, recall = parts
    total = precision + recall
    score = torch.where(total > 0, 2 * precision * recall / torch.where(total > 0, total, 1.0), 0.0)
    return torch.stack([score, precision, recall], dim=1).float()


def _to_nearest(
    queries: Tensor, queries_ptr: Tensor, points: Tensor, ptr: Tensor, squared: bool, norm: str, backend: str
) -> tuple[Tensor, Tensor]:
    """Return the nearest row of its cloud for every query (Q,), and the distance to it (Q,) with a gradient."""
    find = finder(points, ptr, None, backend, norm)
    index, _ = find(1, queries=queries.detach(), queries_ptr=queries_ptr)
    nearest = index[:, 0]
    if norm == "l1":
        distance = norm_length(queries - points[nearest], norm)
        return nearest, distance * distance if squared else distance
    distance = squared_distance(queries, points[nearest])
    return nearest, distance if squared else root(distance)


def root(squared: Tensor) -> Tensor:
    """Return square roots with a gradient that is 0 at 0."""
    apart = squared > 0
    return torch.where(apart, torch.where(apart, squared, 1.0).sqrt(), 0.0)


def mean_per_cloud(values: Tensor, ptr: Tensor) -> Tensor:
    """Average (N,) values per cloud into (B,) float64, with a gradient; no cloud may be empty."""
    total = values.new_zeros(len(ptr) - 1, dtype=torch.float64)
    return total.index_add(0, cloud_of_rows(ptr), values.double()) / counts_from_ptr(ptr)
