"""Which points are inside a box."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from pcdata.checks import all_finite
from pcdata.dispatch import inner


@inner
def inside_box(points: Tensor, lower: Sequence[float], upper: Sequence[float]) -> Tensor | None:
    """Return a (N,) bool mask of the (N, 3) points with lower <= point <= upper; None if one is NaN or infinite."""
    if not all_finite(points):  # a comparison would leave them out without a word
        return None
    return ((points >= points.new_tensor(lower)) & (points <= points.new_tensor(upper))).all(dim=1)
