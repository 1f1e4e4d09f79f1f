"""Normalisation, each undone exactly by ``source_from_cloud``: NormalizeUnitSphere, NormalizeWorkspace, Center."""

from __future__ import annotations

import torch

from pcdata.errors import ConfigError, TooFewPointsError
from pcdata.functional.rows import cloud_of_rows, segment_max, segment_mean
from pcdata.geometry import rigid
from pcdata.rng import Streams
from pcdata.structures import NORMALIZED, PointCloud
from pcdata.transforms.base import Params, SpatialTransform, sample_name
from pcdata.transforms.fields import Name, Vec3


class NormalizeUnitSphere(SpatialTransform):
    """Move the mean of every cloud to the origin and scale its farthest point to distance 1 (PointNet's rule)."""

    def unit_given(self) -> str:
        """The result is normalised."""
        return NORMALIZED

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Measure the centre and the radius of every cloud."""
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
        """The result is normalised."""
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
