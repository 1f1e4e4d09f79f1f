"""Where a scene's origin lies, and square columns of it: ShiftToOrigin, RandomColumn."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from pcdata.errors import TooFewPointsError
from pcdata.functional.rows import ptr_after_mask
from pcdata.geometry import rigid
from pcdata.rng import Streams, seeded
from pcdata.structures import PointCloud
from pcdata.transforms.base import Params, SpatialTransform, Transform, sample_name
from pcdata.transforms.fields import Count, Metres

_TRIALS = 100  # columns drawn before a scene counts as too sparse


class ShiftToOrigin(SpatialTransform):
    """Move the box around every cloud: its lowest corner, or the middle of its floor, becomes the origin.

    The z axis must point up. The box's extents go into meta as ``extent``; the frame becomes ``<frame>/corner`` or
    ``<frame>/floor``.

    Args:
        anchor: corner: smallest x, y, z; floor: middle of x and y, smallest z.
    """

    anchor: Literal["corner", "floor"]

    def frame_after(self, frame: str | None) -> str | None:
        """Name the shifted frame."""
        return None if frame is None else f"{frame}/{self.anchor}"

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Measure the box of every cloud."""
        parts = torch.tensor_split(data.points.double(), data.ptr[1:-1].cpu())
        zero = data.points.new_zeros(3, dtype=torch.float64)
        lower = torch.stack([part.amin(dim=0) if len(part) else zero for part in parts])
        upper = torch.stack([part.amax(dim=0) if len(part) else zero for part in parts])
        origin = lower.clone()
        if self.anchor == "floor":
            origin[:, :2] = (lower + upper)[:, :2] / 2
        return {
            "matrix": rigid.from_rotation_translation(torch.eye(3, dtype=torch.float64, device=data.device), -origin),
            "extent": upper - lower,
        }

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Move the cloud and note its extents."""
        moved = super().transform(data, params)
        return moved.with_meta([{"extent": extent} for extent in params["extent"].tolist()])


class RandomColumn(Transform):
    """Keep a square column about a random point: all heights, x and y within half its size of that point.

    Columns with fewer than ``min_points`` are drawn again, 100 times at most. The point goes into meta as
    ``column_center``; the coordinates stay.

    Args:
        size: edge length in x and y.
        min_points: the S3DIS loaders draw on until a column has more than 1024.

    Raises:
        TooFewPointsError: no column has enough points.
    """

    is_random = True

    size: Metres = 1.0
    min_points: Count = 1025

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Draw until a column is full enough."""
        bounds = data.ptr.tolist()
        masks, centers = [], []
        for b, seed in enumerate(streams.seeds().tolist()):
            mask, center = self._draw(data, b, data.points[bounds[b] : bounds[b + 1]], seed)
            masks.append(mask)
            centers.append(center)
        index = torch.nonzero(torch.cat(masks)).squeeze(1)
        return {
            "index": index,
            "ptr": ptr_after_mask(torch.cat(masks), data.ptr),
            "center": torch.stack(centers),
        }

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Pick the rows and note the centres."""
        column = data.select(params["index"], params["ptr"])
        return column.with_meta([{"column_center": center} for center in params["center"].tolist()])

    def _draw(self, data: PointCloud, b: int, points: Tensor, seed: int) -> tuple[Tensor, Tensor]:
        generator = seeded(seed)
        fullest = 0
        for _ in range(_TRIALS if len(points) else 0):
            center = points[int(torch.randint(len(points), (), generator=generator, device="cpu"))]
            mask = ((points[:, :2] - center[:2]).abs() <= self.size / 2).all(dim=1)
            count = int(mask.sum())
            if count >= self.min_points:
                return mask, center
            fullest = max(fullest, count)
        raise TooFewPointsError(
            f"RandomColumn: cloud {b}{sample_name(data, b)}: of {_TRIALS} columns of {self.size} m none has "
            f"{self.min_points} points, the fullest has {fullest} (the cloud {len(points)}); lower min_points, or do "
            "not downsample before it"
        )
