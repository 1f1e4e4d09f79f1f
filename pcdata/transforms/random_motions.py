"""Random motions, one 4x4 per cloud: RandomRotation, RandomTranslation, RandomScale, RandomFlip."""

from __future__ import annotations

from typing import Annotated, Literal

import torch
from annotated_types import Interval
from torch import Tensor

from pcdata.errors import ConfigError
from pcdata.functional.rows import segment_mean
from pcdata.geometry import rigid
from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.transforms.base import Params
from pcdata.transforms.families import SpatialTransform
from pcdata.transforms.field_types import Fraction, NonNegative, Positive, Vec3

About = Literal["origin", "centroid"]


class RandomRotation(SpatialTransform):
    """Rotate every cloud about an axis by a random angle, or by a random rotation.

    Args:
        axis: None = any rotation, uniform over all orientations.
        degrees: angles are drawn from [-degrees, degrees).
        about: the fixed point.
    """

    is_random = True

    axis: Vec3 | None = (0.0, 0.0, 1.0)
    degrees: Annotated[float, Interval(ge=0, le=180)] = 180.0
    about: About = "origin"

    def check_fields(self) -> None:
        """Require a direction, and no angle where there is no axis to measure it about."""
        if self.axis is not None and not any(self.axis):
            raise ConfigError("RandomRotation: axis must not be zero")
        if self.axis is None and self.degrees != 180.0:
            raise ConfigError("RandomRotation: axis None means any rotation, so degrees must stay 180; or give an axis")

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Draw one rotation per cloud."""
        if self.axis is None:
            quaternion = streams.normal(4)  # a normalized Gaussian quaternion is uniform over rotations
            rotation = rigid.rotation_from_quaternion(quaternion)
        else:
            limit = torch.deg2rad(torch.tensor(self.degrees, dtype=torch.float64, device="cpu")).item()
            angle = streams.uniform(-limit, limit)
            axis = torch.nn.functional.normalize(torch.tensor(self.axis, dtype=torch.float64, device="cpu"), dim=0)
            rotation = rigid.rotation_about_axis(axis.expand(len(angle), 3), angle)
        return {"matrix": _about(self.about, data, rotation)}


class RandomTranslation(SpatialTransform):
    """Shift every cloud by a random offset, drawn per axis from [-max_offset, max_offset)."""

    is_random = True

    # In the cloud's unit; one number, or one per axis.
    max_offset: NonNegative | tuple[NonNegative, NonNegative, NonNegative] = 0.02

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Draw one offset per cloud."""
        limit = torch.tensor(self.max_offset, dtype=torch.float64, device="cpu")
        offset = streams.uniform(-1.0, 1.0, 3) * limit
        return {"matrix": rigid.from_rotation_translation(torch.eye(3, dtype=torch.float64, device="cpu"), offset)}


class RandomScale(SpatialTransform):
    """Scale every cloud by a random factor; the unit stays, so objects really become larger or smaller.

    Args:
        low: smallest factor.
        high: largest factor.
        about: the point that stays: the origin, or the centroid of each cloud.
        per_axis: a factor for every axis instead of one for all.
    """

    is_random = True

    low: Positive = 0.9
    high: Positive = 1.1
    about: About = "origin"
    per_axis: bool = False

    def check_fields(self) -> None:
        """Require low <= high."""
        if self.low > self.high:
            raise ConfigError(f"RandomScale: low {self.low} exceeds high {self.high}")

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Draw one factor, or three, per cloud."""
        factors = streams.uniform(self.low, self.high, 3 if self.per_axis else 1)
        return {"matrix": _about(self.about, data, torch.diag_embed(factors.expand(-1, 3)))}


class RandomFlip(SpatialTransform):
    """Mirror every cloud along each axis with a probability.

    A mirrored scene has mirrored objects: poses (grasps) cannot follow, and ``rigid.map_poses`` refuses them.

    Args:
        probability: that x, y and z are mirrored, each drawn by itself.
        about: the point that stays: the origin, or the centroid of each cloud.
    """

    is_random = True

    probability: tuple[Fraction, Fraction, Fraction] = (0.5, 0.0, 0.0)
    about: About = "origin"

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Draw the signs per cloud."""
        flipped = streams.uniform(0.0, 1.0, 3) < torch.tensor(self.probability, dtype=torch.float64, device="cpu")
        signs = torch.ones_like(flipped, dtype=torch.float64).masked_fill_(flipped, -1.0)
        return {"matrix": _about(self.about, data, torch.diag_embed(signs))}


def _about(point: About, data: PointCloud, linear: Tensor) -> Tensor:
    """Return (B, 4, 4) that apply (B, 3, 3) about the origin or about each cloud's mean."""
    if point == "origin":
        return rigid.from_rotation_translation(linear, linear.new_zeros(3))
    center = segment_mean(data.points, data.ptr).to(linear.device)
    shift = center - (linear @ center[:, :, None]).squeeze(-1)
    return rigid.from_rotation_translation(linear, shift)
