"""What is in front at every pixel, painted: colors and normals of points, or mixed from the corners of triangles."""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner


@inner
def shaded(
    values: Tensor,  # (N, 3) float32 of the points
    item: Tensor,  # (P,) int64 in front
    num_items: int,  # item is at least this where nothing is
    corners: Tensor | None = None,  # (T, K) int64 points of each item; None = items are the points
    weights: Tensor | None = None,  # (P, K) float32 of the corners
    *,
    as_bytes: bool = False,
    backend: str = "auto",
) -> Tensor:  # (P, 3) float32, or 255 times that as uint8
    """Return the values of what is in front, 0 where nothing is; bytes are rounded, halves to even, and clamped."""
    found = (item < num_items).nonzero().squeeze(1)
    front = item[found]
    if corners is None or weights is None:
        mixed = values[front]
    else:
        parts = [values[corners[front, k]] * weights[found, k, None] for k in range(corners.shape[1])]
        mixed = parts[0]
        for part in parts[1:]:
            mixed = mixed + part
    if as_bytes:
        mixed = (255 * mixed).round().clamp(0, 255)
    result = torch.zeros(len(item), 3, dtype=torch.uint8 if as_bytes else torch.float32, device=values.device)
    result[found] = mixed.to(result.dtype)
    return result
