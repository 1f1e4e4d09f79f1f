"""Random motions, one 4x4 per cloud: RandomRotation, RandomTranslation, RandomScale, RandomShear, RandomFlip."""

from __future__ import annotations

import functools
import math
from typing import Annotated

import torch
from annotated_types import Interval
from torch import Tensor

from pcdata.errors import ConfigError
from pcdata.functional.motions import ENTRY, SIGN, TURN
from pcdata.geometry import rigid
from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.transforms.base import Params
from pcdata.transforms.drawn_motions import About, Drawn, DrawnMotion, about_point
from pcdata.transforms.field_types import Fraction, Positive, Vec3

Angles = tuple[float, float]  # degrees, from and to


class RandomRotation(DrawnMotion):
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

    def drawn(self) -> Drawn | None:
        """The angles; a rotation about any axis is drawn from normal numbers."""
        if self.degrees_xyz is None and self.axis is None:
            return None
        return _turns(self.axis, self.degrees, self.degrees_xyz)

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Draw one rotation per cloud."""
        if self.drawn() is not None:
            return super().make_params(data, streams)
        quaternion = streams.normal(4)  # a normalized Gaussian quaternion is uniform over rotations
        return {"matrix": about_point(self.about, data, rigid.rotation_from_quaternion(quaternion))}


@functools.lru_cache(maxsize=64)
def _turns(axis: Vec3 | None, degrees: float | Angles, degrees_xyz: tuple[Angles, Angles, Angles] | None) -> Drawn:
    if degrees_xyz is not None:
        rows = [
            (TURN, math.radians(low), math.radians(high), float(i == 0), float(i == 1), float(i == 2))
            for i, (low, high) in enumerate(degrees_xyz)
        ]
        return tuple(rows), (0, 1, 2)
    assert axis is not None
    length = math.hypot(*axis)
    ends = degrees if isinstance(degrees, tuple) else (-degrees, degrees)
    x, y, z = (one / length for one in axis)
    return ((TURN, math.radians(ends[0]), math.radians(ends[1]), x, y, z),), (0,)


class RandomTranslation(DrawnMotion):
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

    def drawn(self) -> Drawn:
        """The offset along each axis."""
        return _shifts(self.max_offset, self.min_offset)


@functools.lru_cache(maxsize=64)
def _shifts(high: float | Vec3, low: float | Vec3 | None) -> Drawn:
    highs, lows = _of_axes(high), _of_axes(low) if low is not None else [-one for one in _of_axes(high)]
    return tuple((ENTRY, lows[i], highs[i], float(i), 3.0, 0.0) for i in range(3)), (0, 1, 2)


def _of_axes(value: float | Vec3) -> list[float]:
    return [float(one) for one in (value if isinstance(value, tuple) else (value,) * 3)]


class RandomScale(DrawnMotion):
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

    def drawn(self) -> Drawn:
        """One factor for all axes, or one for each."""
        return _factors(self.low, self.high, self.per_axis)


@functools.lru_cache(maxsize=64)
def _factors(low: float | Vec3, high: float | Vec3, per_axis: bool) -> Drawn:
    lows, highs = _of_axes(low), _of_axes(high)
    rows = tuple((ENTRY, lows[i], highs[i], float(i), float(i), 0.0) for i in range(3))
    return rows, (0, 1, 2) if per_axis else (0, 0, 0)


Row3 = tuple[float, float, float]
Shears = tuple[Row3, Row3, Row3]


class RandomShear(DrawnMotion):
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

    def drawn(self) -> Drawn:
        """The six shears, row by row."""
        return _shears(self.low, self.high)


@functools.lru_cache(maxsize=64)
def _shears(low: float | Shears, high: float | Shears) -> Drawn:
    ends = [[[end] * 3 for _ in range(3)] if isinstance(end, float | int) else end for end in (low, high)]
    rows = [
        (ENTRY, ends[0][i][j], ends[1][i][j], float(i), float(j), 0.0) for i in range(3) for j in range(3) if i != j
    ]
    return tuple(rows), tuple(range(6))


class RandomFlip(DrawnMotion):
    """Mirror every cloud along each axis with a probability.

    A mirrored scene has mirrored objects: poses (grasps) cannot follow, and ``rigid.map_poses`` refuses them.

    Args:
        probability: that x, y and z are mirrored, each drawn by itself.
        about: the point that stays.
    """

    is_random = True

    probability: tuple[Fraction, Fraction, Fraction] = (0.5, 0.0, 0.0)
    about: About = "origin"

    def drawn(self) -> Drawn:
        """The sign of each axis."""
        return tuple((SIGN, part, 0.0, float(i), 0.0, 0.0) for i, part in enumerate(self.probability)), (0, 1, 2)
