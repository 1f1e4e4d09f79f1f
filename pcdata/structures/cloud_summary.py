"""What a cloud says of itself in some lines."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from pcdata.functional.neighbors import knn

if TYPE_CHECKING:
    from pcdata.structures.point_cloud import PointCloud

_ASKED = 2000  # points whose nearest neighbor is looked for: the median of their distances is known to 3 per cent


def cloud_summary(cloud: PointCloud) -> str:
    """Return bounds, spacing and every field of a cloud, all clouds of a batch together."""
    lines = [repr(cloud)]
    points = cloud.points.detach()
    if not len(points):
        return "\n".join([*lines, "no points"])
    low, high = points.amin(0).tolist(), points.amax(0).tolist()
    ranges = ", ".join(f"{name} {a:.4g} to {b:.4g}" for name, a, b in zip("xyz", low, high))
    lines.append(f"bounds: {ranges} {cloud.unit}")
    if (spacing := _spacing(cloud)) is not None:
        lines.append(f"spacing: {spacing:.3g} {cloud.unit} to the nearest neighbor (median)")
    lines += [f"{name}: {_told(value.detach())}" for name, value in cloud.fields().items() if name != "points"]
    return "\n".join(lines)


def _spacing(cloud: PointCloud) -> float | None:
    """Return the median distance to the nearest other point of the same cloud, of every k-th point."""
    counts = cloud.counts
    if int(counts.max()) < 2:
        return None
    largest = int(counts.argmax())
    points = cloud.points.detach()[int(cloud.ptr[largest]) : int(cloud.ptr[largest + 1])]
    asked = points[:: max(1, len(points) // _ASKED)]
    _, distance = knn(points, k=2, queries=asked)
    return float(distance[:, 1].median())


def _told(value: torch.Tensor) -> str:
    shape = "" if value.dim() == 1 else f" x {'x'.join(map(str, value.shape[1:]))}"
    kind = str(value.dtype).removeprefix("torch.")
    if not value.dtype.is_floating_point:
        different = len(torch.unique(value)) if value.dim() == 1 else 0
        return f"{kind}{shape}, {int(value.min())} to {int(value.max())}" + (
            f", {different} values" if different else ""
        )
    return f"{kind}{shape}, {float(value.min()):.4g} to {float(value.max()):.4g}"
