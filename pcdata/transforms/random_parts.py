"""Random parts of a scene missing: RandomCuboid, RandomOcclusion."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from pcdata.errors import ConfigError, FrameError
from pcdata.functional.rows import cloud_of_rows, ptr_after_mask, segment_mean
from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.transforms.base import Params
from pcdata.transforms.decisions import Decisions
from pcdata.transforms.families import RemoveTransform
from pcdata.transforms.field_types import Fraction, Positive


class RandomCuboid(RemoveTransform):
    """Keep, or drop, the points in a random box about a random point of every cloud; at least one point stays.

    ``keep="inside"`` is a random crop, ``"outside"`` cuboid dropout: a part of the scene that the camera missed.

    Args:
        low: smallest edge along x, y and z, in the cloud's unit; one, or one for each.
        high: largest edge, likewise.
        keep: what stays.
    """

    is_random = True
    decides_by = "point"
    version = 2

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

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Draw the point and the edges, then look which points are inside."""
        low, high = self._edges()
        drawn = streams.uniform(0.0, 1.0, 4)
        counts = data.counts.cpu()
        row = data.ptr[:-1].cpu() + (drawn[:, 0] * counts).long().clamp(max=(counts - 1).clamp(min=0))
        row = row.clamp(max=max(data.num_points - 1, 0)).to(data.device)
        half = ((low + (high - low) * drawn[:, 1:]) / 2).to(data.device)
        center = torch.zeros_like(half)  # of a cloud without points
        some = data.counts > 0
        center[some] = data.points.detach().double()[row[some]]
        return self._chosen(data, center, half)

    def repeat(self, data: PointCloud, decided: Decisions) -> Params:
        """The box that the history tells; a point of the data at its middle stays where it holds all of them."""
        like = torch.empty(0, 3, dtype=torch.float64, device="cpu")
        return self._chosen(data, *(decided.values(name, like=like).to(data.device) for name in ("center", "half")))

    def _chosen(self, cloud: PointCloud, center: Tensor, half: Tensor) -> Params:
        owner = cloud_of_rows(cloud.ptr)
        offset = cloud.points.detach().double() - center[owner]
        inside = (offset.abs() <= half[owner]).all(1)
        keep = inside if self.keep == "inside" else ~inside
        # A box around all of a cloud leaves the point at its middle.
        left = torch.zeros(cloud.num_clouds, dtype=torch.int64, device=cloud.device).index_add_(0, owner, keep.long())
        keep = keep | ((left == 0)[owner] & (offset == 0).all(1))
        return {"index": keep, "ptr": ptr_after_mask(keep, cloud.ptr), "center": center, "half": half}


class RandomOcclusion(RemoveTransform):
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
    decides_by = "point"
    version = 2

    low: Fraction = 0.1
    high: Fraction = 0.4

    def check_fields(self) -> None:
        """Require low <= high."""
        if self.low > self.high:
            raise ConfigError(f"RandomOcclusion: low {self.low} exceeds high {self.high}")

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Draw the angle and the part, then hide the points farthest that way in the picture."""
        if data.viewpoint is None:
            raise FrameError(
                "RandomOcclusion: needs the viewpoint of each cloud, where its sensor stood; set PointCloud.viewpoint, "
                "and put it before MergeViews"
            )
        angle, part = streams.uniform(0.0, 2 * torch.pi), streams.uniform(self.low, self.high)
        origin = data.viewpoint.double()
        ray = data.points.detach().double() - origin[cloud_of_rows(data.ptr)]
        forward = torch.nn.functional.normalize(segment_mean(ray, data.ptr), dim=1)
        # Two directions across: from the axis that the forward direction is least along.
        least = torch.nn.functional.one_hot(forward.abs().argmin(1), 3).double()
        aside = torch.nn.functional.normalize(torch.linalg.cross(least, forward), dim=1)
        upward = torch.linalg.cross(forward, aside)
        angle = angle.to(data.device)[:, None]
        across = angle.cos() * aside + angle.sin() * upward
        place = self._places(data, origin, forward, across)
        visible = ptr_after_mask(place > -torch.inf, data.ptr).diff()
        hidden = torch.minimum((part.to(data.device) * visible).round().long(), (data.counts - 1).clamp(min=0))
        # The outermost point that stays; what lies as far out stays with it.
        order = place.argsort(stable=True)
        order = order[cloud_of_rows(data.ptr)[order].argsort(stable=True)]
        last = (data.ptr[1:] - 1 - hidden).clamp(min=0)
        limit = place.new_zeros(data.num_clouds)
        some = data.counts > 0
        limit[some] = place[order][last[some]]
        limit.clamp_(min=torch.finfo(torch.float64).min)  # where all that is before the sensor is hidden
        return self._chosen(data, origin, forward, across, limit)

    def repeat(self, data: PointCloud, decided: Decisions) -> Params:
        """The half space that the history tells."""
        vector, number = (torch.empty(0, *shape, dtype=torch.float64, device="cpu") for shape in ((3,), ()))
        like = {"origin": vector, "forward": vector, "across": vector, "limit": number}
        return self._chosen(data, *(decided.values(name, like=one).to(data.device) for name, one in like.items()))

    def _chosen(self, cloud: PointCloud, origin: Tensor, forward: Tensor, across: Tensor, limit: Tensor) -> Params:
        keep = self._places(cloud, origin, forward, across) <= limit[cloud_of_rows(cloud.ptr)]
        ptr = ptr_after_mask(keep, cloud.ptr)
        return {"index": keep, "ptr": ptr, "origin": origin, "forward": forward, "across": across, "limit": limit}

    @staticmethod
    def _places(cloud: PointCloud, origin: Tensor, forward: Tensor, across: Tensor) -> Tensor:
        """(N,): how far out each point is seen, as a slope; -inf beside and behind the sensor."""
        owner = cloud_of_rows(cloud.ptr)
        ray = cloud.points.detach().double() - origin[owner]
        depth, place = ((ray * direction[owner]).sum(1) for direction in (forward, across))
        before = depth > 0
        return torch.where(before, place / torch.where(before, depth, 1.0), -torch.inf)
