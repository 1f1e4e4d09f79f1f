"""Random parts of a scene missing: RandomCuboid, RandomOcclusion."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from pcdata.errors import ConfigError, FrameError
from pcdata.functional.rows import cloud_of_rows, ptr_after_mask, ptr_from_counts, segment_mean
from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.transforms.families import SelectTransform
from pcdata.transforms.field_types import Fraction, Positive


class RandomCuboid(SelectTransform):
    """Keep, or drop, the points in a random box about a random point of every cloud; at least one point stays.

    ``keep="inside"`` is a random crop, ``"outside"`` cuboid dropout: a part of the scene that the camera missed.

    Args:
        low: smallest edge along x, y and z, in the cloud's unit; one, or one for each.
        high: largest edge, likewise.
        keep: what stays.
    """

    is_random = True

    low: Positive | tuple[Positive, Positive, Positive] = 0.05
    high: Positive | tuple[Positive, Positive, Positive] = 0.2
    keep: Literal["inside", "outside"] = "outside"

    def check_fields(self) -> None:
        """Require low <= high."""
        low, high = self._edges()
        if bool((low > high).any()):
            raise ConfigError(f"RandomCuboid: low {self.low} exceeds high {self.high}")

    def _edges(self) -> tuple[Tensor, Tensor]:
        low, high = (torch.tensor(end, dtype=torch.float64, device="cpu") for end in (self.low, self.high))
        return low.expand(3), high.expand(3)

    def pick(self, cloud: PointCloud, streams: Streams) -> tuple[Tensor, Tensor]:
        """Draw the point and the edges, then look which points are inside."""
        low, high = self._edges()
        drawn = streams.uniform(0.0, 1.0, 4)
        counts = cloud.counts.cpu()
        row = cloud.ptr[:-1].cpu() + (drawn[:, 0] * counts).long().clamp(max=(counts - 1).clamp(min=0))
        row = row.clamp(max=max(cloud.num_points - 1, 0)).to(cloud.device)
        half = ((low + (high - low) * drawn[:, 1:]) / 2).to(cloud.device)
        if not cloud.num_points:
            return torch.zeros(0, dtype=torch.bool, device=cloud.device), cloud.ptr
        owner = cloud_of_rows(cloud.ptr)
        offset = cloud.points.detach().double() - cloud.points.detach().double()[row][owner]
        inside = (offset.abs() <= half[owner]).all(1)
        keep = inside if self.keep == "inside" else ~inside
        # A box around all of a cloud leaves the point at its middle.
        left = torch.zeros(cloud.num_clouds, dtype=torch.int64, device=cloud.device).index_add_(0, owner, keep.long())
        keep[row[(left == 0) & (cloud.counts > 0)]] = True
        return keep, ptr_after_mask(keep, cloud.ptr)


class RandomOcclusion(SelectTransform):
    """Drop what lies beyond a random plane through the sensor: a side of the picture, as if something stood before it.

    The plane passes the viewpoint of each cloud at a random angle in the picture, so that a random part of the points
    before the sensor is hidden. Points keep their order, and at least one stays.

    Args:
        low: smallest part that is hidden.
        high: largest part that is hidden.

    Raises:
        FrameError: the clouds do not know where the sensor stood, or were merged of several views.
    """

    is_random = True

    low: Fraction = 0.1
    high: Fraction = 0.4

    def check_fields(self) -> None:
        """Require low <= high."""
        if self.low > self.high:
            raise ConfigError(f"RandomOcclusion: low {self.low} exceeds high {self.high}")

    def pick(self, cloud: PointCloud, streams: Streams) -> tuple[Tensor, Tensor]:
        """Draw the angle and the part, then hide the points farthest that way in the picture."""
        if cloud.viewpoint is None:
            raise FrameError(
                "RandomOcclusion: needs the viewpoint of each cloud, where its sensor stood; set PointCloud.viewpoint, "
                "and put it before MergeViews"
            )
        angle, part = streams.uniform(0.0, 2 * torch.pi), streams.uniform(self.low, self.high)
        owner = cloud_of_rows(cloud.ptr)
        ray = cloud.points.detach().double() - cloud.viewpoint.double()[owner]
        forward = torch.nn.functional.normalize(segment_mean(ray, cloud.ptr), dim=1)
        # Two directions across: from the axis that the forward direction is least along.
        least = torch.nn.functional.one_hot(forward.abs().argmin(1), 3).double()
        aside = torch.nn.functional.normalize(torch.linalg.cross(least, forward), dim=1)
        upward = torch.linalg.cross(forward, aside)
        angle = angle.to(cloud.device)[:, None]
        across = angle.cos() * aside + angle.sin() * upward
        depth, place = ((ray * direction[owner]).sum(1) for direction in (forward, across))
        before = depth > 0
        place = torch.where(before, place / torch.where(before, depth, 1.0), -torch.inf)
        hidden = (part.to(cloud.device) * ptr_after_mask(before, cloud.ptr).diff()).round().long()
        hidden = torch.minimum(hidden, (cloud.counts - 1).clamp(min=0))
        order = place.argsort(descending=True, stable=True)
        order = order[owner[order].argsort(stable=True)]
        rank = torch.arange(cloud.num_points, dtype=torch.int64, device=cloud.device) - cloud.ptr[:-1][owner]
        keep = torch.empty_like(before)
        keep[order] = rank >= hidden[owner]
        return keep, ptr_from_counts(cloud.counts - hidden)
