"""Random motions, one 4x4 per cloud: RandomRotation, RandomTranslation, RandomScale, RandomShear, RandomFlip."""

from __future__ import annotations

import functools
import math
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
from pcdata.transforms.field_types import Fraction, Positive, Vec3

# The point that stays: the origin, the mean of each cloud, or a point in the cloud's unit.
About = Literal["origin", "centroid"] | Vec3
Angles = tuple[float, float]  # degrees, from and to


class RandomRotation(SpatialTransform):
    """Rotate every cloud about an axis by a random angle, about all three, or by a random rotation.

    Args:
        axis: None = any rotation, uniform over all orientations.
        degrees: angles are drawn from [-degrees, degrees), or from [low, high) where two are given.
        degrees_xyz: instead of axis and degrees: ranges [low, high) of the angles about x, then y, then z of the frame.
        about: the fixed point.
    """

    is_random = True

    axis: Vec3 | None = (0.0, 0.0, 1.0)
    degrees: Annotated[float, Interval(ge=0, le=180)] | Angles = 180.0
    degrees_xyz: tuple[Angles, Angles, Angles] | None = None
    about: About = "origin"

    def check_fields(self) -> None:
        """Require a direction, and no angle where there is no axis to measure it about."""
        if self.axis is not None and not any(self.axis):
            raise ConfigError("RandomRotation: axis must not be zero")
        if self.axis is None and self.degrees != 180.0:
            raise ConfigError("RandomRotation: axis None means any rotation, so degrees must stay 180; or give an axis")
        if self.degrees_xyz is not None and (self.axis != (0.0, 0.0, 1.0) or self.degrees != 180.0):
            raise ConfigError("RandomRotation: give either degrees_xyz, or an axis and degrees")
        ranges = [self.degrees] if isinstance(self.degrees, tuple) else []
        for low, high in [*ranges, *(self.degrees_xyz or ())]:
            if not -360 <= low <= high <= 360:
                raise ConfigError(f"RandomRotation: degrees from {low} to {high} are no range within -360 to 360")

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Draw one rotation per cloud."""
        if self.degrees_xyz is not None:
            low, high = torch.tensor(self.degrees_xyz, dtype=torch.float64, device="cpu").unbind(1)
            angles = torch.deg2rad(low + (high - low) * streams.uniform(0.0, 1.0, 3))
            axes = torch.eye(3, dtype=torch.float64, device="cpu")
            x, y, z = (
                rigid.rotation_about_axis(axes[i].expand(len(angles), 3), angle)
                for i, angle in enumerate(angles.unbind(1))
            )
            rotation = z @ y @ x
        elif self.axis is None:
            quaternion = streams.normal(4)  # a normalized Gaussian quaternion is uniform over rotations
            rotation = rigid.rotation_from_quaternion(quaternion)
        else:
            from_, to = self.degrees if isinstance(self.degrees, tuple) else (-self.degrees, self.degrees)
            rotation = rigid.rotation_about_axis(
                _direction(self.axis), streams.uniform(math.radians(from_), math.radians(to))
            )
        return {"matrix": _about(self.about, data, rotation)}


@functools.lru_cache(maxsize=64)
def _direction(axis: tuple[float, float, float]) -> Tensor:
    """Return an axis of unit length, (1, 3); not to be changed."""
    return torch.nn.functional.normalize(torch.tensor(axis, dtype=torch.float64, device="cpu"), dim=0)[None]


class RandomTranslation(SpatialTransform):
    """Shift every cloud by a random offset, drawn per axis.

    Args:
        max_offset: in the cloud's unit; one number, or one per axis; offsets are drawn from [-max_offset, max_offset).
        min_offset: the lower ends instead of -max_offset, of the same form.
    """

    is_random = True

    max_offset: float | Vec3 = 0.02
    min_offset: float | Vec3 | None = None

    def check_fields(self) -> None:
        """Require ranges."""
        low, high = self._ends()
        if bool((low > high).any()):
            given = "" if self.min_offset is None else f"min_offset {self.min_offset} to "
            raise ConfigError(f"RandomTranslation: {given}max_offset {self.max_offset} is no range")

    def _ends(self) -> tuple[Tensor, Tensor]:
        high = torch.tensor(self.max_offset, dtype=torch.float64, device="cpu")
        if self.min_offset is None:
            return -high, high
        return torch.tensor(self.min_offset, dtype=torch.float64, device="cpu"), high

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Draw one offset per cloud."""
        low, high = self._ends()
        drawn = streams.uniform(-1.0, 1.0, 3)
        offset = drawn * high if self.min_offset is None else low + (high - low) * (drawn + 1.0) / 2
        return {"matrix": rigid.from_rotation_translation(torch.eye(3, dtype=torch.float64, device="cpu"), offset)}


class RandomScale(SpatialTransform):
    """Scale every cloud by a random factor; the unit stays, so objects really become larger or smaller.

    Args:
        low: smallest factor; one, or with per_axis one for each.
        high: largest factor, likewise.
        about: the point that stays.
        per_axis: a factor for every axis instead of one for all.
    """

    is_random = True

    low: Positive | tuple[Positive, Positive, Positive] = 0.9
    high: Positive | tuple[Positive, Positive, Positive] = 1.1
    about: About = "origin"
    per_axis: bool = False

    def check_fields(self) -> None:
        """Require low <= high."""
        if not self.per_axis and (isinstance(self.low, tuple) or isinstance(self.high, tuple)):
            raise ConfigError("RandomScale: factors for each axis need per_axis: true")
        low, high = self._ends()
        if bool((low > high).any()):
            raise ConfigError(f"RandomScale: low {self.low} exceeds high {self.high}")

    def _ends(self) -> tuple[Tensor, Tensor]:
        low, high = (torch.tensor(end, dtype=torch.float64, device="cpu") for end in (self.low, self.high))
        return low, high

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Draw one factor, or three, per cloud."""
        low, high = self._ends()
        factors = low + (high - low) * streams.uniform(0.0, 1.0, 3 if self.per_axis else 1)
        return {"matrix": _about(self.about, data, torch.diag_embed(factors.expand(-1, 3)))}


Row3 = tuple[float, float, float]
Shears = tuple[Row3, Row3, Row3]


class RandomShear(SpatialTransform):
    """Shear every cloud: each coordinate moves along each other axis by a random part of it.

    A point (x, y, z) goes to (x + a y + b z, c x + y + d z, e x + f y + z). Normals stay at right angles to their
    surfaces; a sheared scene has sheared objects.

    Args:
        low: smallest shear; one for all six, or a 3x3 with zeros on its diagonal, whose entry [i][j] is the way along
            axis i per length along axis j.
        high: largest shear, likewise.
        about: the point that stays.

    Raises:
        ConfigError: along an axis the largest shears add up to 1 or more, where a cloud may be flattened or mirrored.
    """

    is_random = True

    low: float | Shears = -0.1
    high: float | Shears = 0.1
    about: About = "origin"

    def check_fields(self) -> None:
        """Require ranges that neither flatten nor mirror."""
        low, high = self._ends()
        if bool((low > high).any()):
            raise ConfigError(f"RandomShear: low {self.low} exceeds high {self.high}")
        if bool((torch.diagonal(low) != 0).any() or (torch.diagonal(high) != 0).any()):
            raise ConfigError("RandomShear: the diagonal of low and high must be 0; RandomScale changes the extent")
        # Gershgorin: then no eigenvalue reaches 0.
        if bool((torch.maximum(low.abs(), high.abs()).sum(1) >= 1).any()):
            raise ConfigError(
                f"RandomShear: the shears along an axis must add up to less than 1, got low {self.low}, high "
                f"{self.high}"
            )

    def _ends(self) -> tuple[Tensor, Tensor]:
        ends = []
        for end in (self.low, self.high):
            matrix = torch.tensor(end, dtype=torch.float64, device="cpu")
            ends.append(matrix if matrix.ndim else matrix.repeat(3, 3).fill_diagonal_(0.0))
        return ends[0], ends[1]

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Draw six shears per cloud."""
        low, high = self._ends()
        linear = torch.eye(3, dtype=torch.float64, device="cpu") + low + (high - low) * streams.uniform(0.0, 1.0, 3, 3)
        return {"matrix": _about(self.about, data, linear)}


class RandomFlip(SpatialTransform):
    """Mirror every cloud along each axis with a probability.

    A mirrored scene has mirrored objects: poses (grasps) cannot follow, and ``rigid.map_poses`` refuses them.

    Args:
        probability: that x, y and z are mirrored, each drawn by itself.
        about: the point that stays.
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
    """Return (B, 4, 4) that apply (B, 3, 3) about the origin, about each cloud's mean, or about a point."""
    if point == "origin":
        return rigid.from_rotation_translation(linear, linear.new_zeros((len(linear), 3)))
    if point == "centroid":
        center = segment_mean(data.points, data.ptr).to(linear.device)
    else:
        center = linear.new_tensor(point).expand(len(linear), 3)
    shift = center - (linear @ center[:, :, None]).squeeze(-1)
    return rigid.from_rotation_translation(linear, shift)
