"""How far two clouds are apart point by point: the earth mover's distance."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor

from pcdata.contracts.tensors import check_tensors
from pcdata.errors import ConfigError
from pcdata.functional.metrics import mean_per_cloud, root
from pcdata.functional.nearest import squared_distance
from pcdata.functional.rows import counts_from_ptr, ptr_from_counts

_SPECS = {"points_a": "N 3", "points_b": "M 3", "ptr_a": "ptr N B >= 1", "ptr_b": "ptr M B >= 1"}


def earth_movers_distance(
    points_a: Tensor,  # (N, 3) float32
    ptr_a: Tensor | None,  # (B+1,); None = one cloud
    points_b: Tensor,  # (N, 3) float32
    ptr_b: Tensor | None,  # (B+1,); None = one cloud
    *,
    squared: bool = False,
) -> Tensor:  # (B,) float32
    """Return the mean distance between the points of two clouds in the best one-to-one matching.

    Exact, by SciPy's ``linear_sum_assignment`` on the CPU, cloud by cloud; time cubic in the number of points and
    memory in its square. Cloud b of both must have as many points. The result carries gradients to both clouds for the
    matching as it is.

    Args:
        points_a: one of the clouds.
        ptr_a: row pointers.
        points_b: the other.
        ptr_b: row pointers.
        squared: match, and average, squared distances.

    Raises:
        TooFewPointsError: a cloud is empty; the message names it.
        ConfigError: two clouds of different numbers of points.
        ShapeError, DTypeError, DeviceError, NonFiniteError: an argument breaks the contract above.

    Source: Rubner et al., The earth mover's distance as a metric for image retrieval, IJCV 40(2), 2000.
    """
    where = "earth_movers_distance"
    tensors = {"points_a": points_a, "points_b": points_b}
    check_tensors(where, tensors, _SPECS)
    ptr_a, ptr_b = (
        ptr_from_counts([len(points)], device=points.device) if ptr is None else ptr
        for points, ptr in ((points_a, ptr_a), (points_b, ptr_b))
    )
    check_tensors(where, {**tensors, "ptr_a": ptr_a, "ptr_b": ptr_b}, _SPECS, finite=False)
    for cloud, (one, other) in enumerate(zip(counts_from_ptr(ptr_a).tolist(), counts_from_ptr(ptr_b).tolist())):
        if one != other:
            raise ConfigError(f"{where}: clouds {cloud} have {one} and {other} points; sample both to the same number")
    matched = points_b[_best_matches(points_a, ptr_a, points_b, squared=squared)]
    distance = squared_distance(points_a, matched)
    return mean_per_cloud(distance if squared else root(distance), ptr_a).float()


def _best_matches(points_a: Tensor, ptr: Tensor, points_b: Tensor, *, squared: bool) -> Tensor:
    """Return (N,) int64: the row of b that each row of a is matched to."""
    from scipy.optimize import linear_sum_assignment  # imported late: only this function needs it

    matches = []
    a, b = points_a.detach().cpu().double(), points_b.detach().cpu().double()
    bounds = ptr.tolist()
    for start, stop in pairwise(bounds):
        cost = torch.cdist(a[start:stop], b[start:stop], compute_mode="donot_use_mm_for_euclid_dist")
        _, chosen = linear_sum_assignment((cost * cost if squared else cost).numpy())
        matches.append(start + torch.from_numpy(chosen))
    return torch.cat(matches).to(points_a.device)
