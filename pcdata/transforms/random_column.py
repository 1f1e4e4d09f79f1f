"""RandomColumn: a square column of a scene about a random point."""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.contracts.on_host import counts_of, uploaded
from pcdata.errors import TooFewPointsError
from pcdata.functional.rows import cloud_of_rows, counts_from_ptr, ptr_after_mask
from pcdata.rng import Streams, words
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
    version = 2

    size: Metres = 1.0
    min_points: Count = 1025

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Draw a point of every cloud, and again of those whose column is not full enough."""
        seeds, owner = uploaded(streams.seeds(), data.device), cloud_of_rows(data.ptr)
        counts, first = counts_from_ptr(data.ptr), data.ptr[:-1]
        centers = data.points.new_zeros((data.num_clouds, 3))
        fullest = torch.zeros_like(counts)
        searched = torch.ones_like(counts, dtype=torch.bool)  # clouds without a column yet
        rows = torch.arange(data.num_points, dtype=torch.int64, device=data.device)  # of those
        for trial in range(_TRIALS if data.num_points else 0):
            drawn = (words(seeds, torch.full_like(seeds, trial)) >> 1 & (2**62 - 1)) % counts.clamp(min=1)
            place = data.points[(first + drawn).clamp(max=data.num_points - 1)]
            inside = rows[self._in_columns(data.points[rows], place[owner[rows]])]
            found = torch.zeros_like(counts).index_add_(0, owner[inside], torch.ones_like(inside))
            fullest = torch.maximum(fullest, found)
            full = searched & (found >= self.min_points)
            centers = torch.where(full[:, None], place, centers)
            searched = searched & ~full
            rows = rows[searched[owner[rows]]]
            if not len(rows):
                break
        if bool(searched.any()):
            self._refuse(data, int(searched.nonzero()[0]), fullest)
        return self._around(data, centers)

    def repeat(self, data: PointCloud, decided: Decisions) -> Params:
        """The columns about the points that the history tells, however full."""
        like = torch.empty(0, 3, dtype=torch.float32, device="cpu")
        return self._around(data, decided.values("center", like=like).to(data.device))

    def _around(self, data: PointCloud, centers: Tensor) -> Params:
        mask = self._in_columns(data.points, centers[cloud_of_rows(data.ptr)])
        index = torch.nonzero(mask).squeeze(1)
        return {"index": index, "ptr": ptr_after_mask(mask, data.ptr), "center": centers}

    def _in_columns(self, points: Tensor, centers: Tensor) -> Tensor:
        return ((points[:, :2] - centers[:, :2]).abs() <= self.size / 2).all(dim=1)

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Pick the rows and note the centers."""
        column = data.select(params["index"], params["ptr"])
        return column.with_meta([{"column_center": center} for center in params["center"].tolist()])

    def _refuse(self, data: PointCloud, b: int, fullest: Tensor) -> None:
        raise TooFewPointsError(
            f"RandomColumn: cloud {b}{sample_name(data, b)}: of {_TRIALS} columns of {self.size} m none has "
            f"{self.min_points} points, the fullest has {int(fullest[b])} (the cloud {counts_of(data.ptr)[b]}); lower "
            "min_points, or do not downsample before it"
        )
