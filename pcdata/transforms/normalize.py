"""Where the origin lies, and scale, each undone by ``source_from_cloud``: normalizations, Center, ShiftToOrigin."""

from __future__ import annotations

from typing import Literal

import torch

from pcdata.errors import ConfigError, TooFewPointsError
from pcdata.functional.rows import cloud_of_rows, segment_max, segment_mean, segment_min
from pcdata.geometry import rigid
from pcdata.rng import Streams
from pcdata.structures import NORMALIZED, PointCloud
from pcdata.transforms.base import Params, sample_name
from pcdata.transforms.decisions import Decisions
from pcdata.transforms.families import SpatialTransform
from pcdata.transforms.field_types import Name, Vec3


class NormalizeUnitSphere(SpatialTransform):
    """Move the mean of every cloud to the origin and scale its farthest point to distance 1 (PointNet's rule)."""

    def unit_given(self) -> str:
        """The result is normalized."""
        return NORMALIZED

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Measure the center and the radius of every cloud."""
        center = segment_mean(data.points, data.ptr)
        offset = data.points.double() - center[cloud_of_rows(data.ptr)]
        radius = segment_max(offset.norm(dim=1), data.ptr)
        for b, value in enumerate(radius.tolist()):
            if not value > 0:
                raise TooFewPointsError(
                    f"NormalizeUnitSphere: cloud {b}{sample_name(data, b)} has no extent (it needs two different "
                    f"points, and has {int(data.counts[b])})"
                )
        factors = (1.0 / radius)[:, None].expand(-1, 3)
        shift = rigid.from_rotation_translation(torch.eye(3, dtype=torch.float64, device=data.device), -center)
        return {"matrix": rigid.scaling(factors) @ shift}


class NormalizeWorkspace(SpatialTransform):
    """Map a box given in a named frame to [-1, 1] on every axis.

    Args:
        frame: the frame that the box is given in.
        lower: metres, smallest x, y, z.
        upper: metres, largest x, y, z.
    """

    needs_metres = True

    frame: Name
    lower: Vec3
    upper: Vec3

    def check_fields(self) -> None:
        """Require lower < upper."""
        if not all(low < high for low, high in zip(self.lower, self.upper)):
            raise ConfigError(
                f"NormalizeWorkspace: lower must be below upper on every axis, got {self.lower}, {self.upper}"
            )

    def frame_needed(self) -> str:
        """The frame of the box."""
        return self.frame

    def unit_given(self) -> str:
        """The result is normalized."""
        return NORMALIZED

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """The same matrix for every cloud."""
        lower, upper = torch.tensor([self.lower, self.upper], dtype=torch.float64, device=data.device)
        shift = rigid.from_rotation_translation(
            torch.eye(3, dtype=torch.float64, device=data.device), -(lower + upper) / 2
        )
        matrix = rigid.scaling(2.0 / (upper - lower)) @ shift
        return {"matrix": matrix.repeat(data.num_clouds, 1, 1)}


class Center(SpatialTransform):
    """Move the mean of every cloud to the origin; the frame becomes ``<frame>/centered``, since its origin moved."""

    def frame_after(self, frame: str | None) -> str | None:
        """Name the shifted frame."""
        return None if frame is None else f"{frame}/centered"

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Measure the mean of every cloud."""
        center = segment_mean(data.points, data.ptr)
        return {
            "matrix": rigid.from_rotation_translation(torch.eye(3, dtype=torch.float64, device=data.device), -center)
        }


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
        lower, upper = (reduce(data.points, data.ptr).double() for reduce in (segment_min, segment_max))
        empty = (data.counts == 0)[:, None]
        lower, upper = lower.masked_fill(empty, 0.0), upper.masked_fill(empty, 0.0)
        origin = lower.clone()
        if self.anchor == "floor":
            origin[:, :2] = (lower + upper)[:, :2] / 2
        return {
            "matrix": rigid.from_rotation_translation(torch.eye(3, dtype=torch.float64, device=data.device), -origin),
            "extent": upper - lower,
        }

    def repeat(self, data: PointCloud, decided: Decisions) -> Params:
        """The motion, and the extents of the box that it was found by."""
        like = torch.empty(0, 3, dtype=torch.float64, device="cpu")
        return {**super().repeat(data, decided), "extent": decided.values("extent", like=like)}

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Move the cloud and note its extents."""
        moved = super().transform(data, params)
        return moved.with_meta([{"extent": extent} for extent in params["extent"].tolist()])
