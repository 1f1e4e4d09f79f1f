"""RandomColumn: a square column of a scene about a random point."""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.contracts.on_host import bounds_of
from pcdata.errors import TooFewPointsError
from pcdata.functional.rows import ptr_after_mask
from pcdata.rng import Streams, seeded
from pcdata.structures import PointCloud
from pcdata.transforms.base import Params, sample_name
from pcdata.transforms.decisions import Decisions
from pcdata.transforms.families import DropLimit
from pcdata.transforms.field_types import Count, Metres

_TRIALS = 100  # columns drawn before a scene counts as too sparse


class RandomColumn(DropLimit):
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
    decides_by = "point"

    size: Metres = 1.0
    min_points: Count = 1025

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Draw until a column is full enough."""
        bounds = bounds_of(data.ptr)
        seeds = streams.seeds().tolist()
        return self._around(
            data,
            [self._draw(data, b, data.points[bounds[b] : bounds[b + 1]], seed) for b, seed in enumerate(seeds)],
        )

    def repeat(self, data: PointCloud, decided: Decisions) -> Params:
        """The columns about the points that the history tells, however full."""
        like = torch.empty(0, 3, dtype=torch.float32, device="cpu")
        return self._around(data, [*decided.values("center", like=like).to(data.device)])

    def _around(self, data: PointCloud, centers: list[Tensor]) -> Params:
        parts = torch.tensor_split(data.points, data.ptr[1:-1].cpu())
        mask = torch.cat([self._column(points, center) for points, center in zip(parts, centers, strict=True)])
        index = torch.nonzero(mask).squeeze(1)
        return {"index": index, "ptr": ptr_after_mask(mask, data.ptr), "center": torch.stack(centers)}

    def _column(self, points: Tensor, center: Tensor) -> Tensor:
        return ((points[:, :2] - center[:2]).abs() <= self.size / 2).all(dim=1)

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Pick the rows and note the centers."""
        column = data.select(params["index"], params["ptr"])
        return column.with_meta([{"column_center": center} for center in params["center"].tolist()])

    def _draw(self, data: PointCloud, b: int, points: Tensor, seed: int) -> Tensor:
        generator = seeded(seed)
        fullest = 0
        for _ in range(_TRIALS if len(points) else 0):
            center = points[int(torch.randint(len(points), (), generator=generator, device="cpu"))]
            count = int(self._column(points, center).sum())
            if count >= self.min_points:
                return center
            fullest = max(fullest, count)
        raise TooFewPointsError(
            f"RandomColumn: cloud {b}{sample_name(data, b)}: of {_TRIALS} columns of {self.size} m none has "
            f"{self.min_points} points, the fullest has {fullest} (the cloud {len(points)}); lower min_points, or do "
            "not downsample before it"
        )
