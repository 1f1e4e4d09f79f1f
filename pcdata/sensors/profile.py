"""SensorProfile: one depth sensor, and the thresholds that follow from its noise and its pixel pitch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from pcdata.sensors.noise import Depth, PolynomialNoise, StereoNoise

Kind = Literal["stereo", "structured_light", "tof", "lidar"]

_SIGMAS = 3.0  # of a normal error, 99.7 % lie within
_STEEPEST = math.tan(math.radians(80.0))  # slope of the most slanted surface that still gives readings


@dataclass(frozen=True, kw_only=True)
class SensorProfile:
    """What one depth sensor, in one mode, is known to do; depths in metres along the optical axis.

    The thresholds are derived, never tuned: from the noise (standard deviation sigma at that depth) and the pitch (the
    distance of neighboring points on a surface facing the sensor). The difference of two readings has a standard
    deviation of sqrt(2) sigma.

    Args:
        name: what `sensor_profile` finds it by.
        title: maker, model and mode.
        kind: how it measures depth.
        size: (height, width) pixels of the mode described; lidar: channels, firings per turn.
        field_of_view: degrees, (vertical, horizontal).
        focal: pixels, nominal, of the mode described; None = not a pinhole camera.
        angular_step: degrees between neighboring rays, (vertical, horizontal); lidar only.
        metres_per_unit: lengths that one stored depth unit is known to have, the default first.
        range: metres, (near, far), where the maker states it works well.
        depth_step: metres: the depth image's own step, on top of the noise.
        sources: figure -> where it is from; "estimate: ..." where nothing was found.
    """

    name: str
    title: str
    kind: Kind
    size: tuple[int, int]
    field_of_view: tuple[float, float]
    focal: float | None
    angular_step: tuple[float, float] | None
    metres_per_unit: tuple[float, ...]
    range: tuple[float, float]
    noise: StereoNoise | PolynomialNoise
    depth_step: float
    sources: Mapping[str, str]

    @property
    def estimates(self) -> tuple[str, ...]:
        """The figures that are estimates, not taken from a source."""
        return tuple(name for name, source in self.sources.items() if source.startswith("estimate"))

    @property
    def is_organized(self) -> bool:
        """Whether its captures are depth images of a pinhole camera; a spinning lidar gives unorganized points."""
        return self.focal is not None

    @property
    def reference_depth(self) -> float:
        """The depth in metres at which defaults are taken: the geometric mean of the range's ends."""
        return math.sqrt(self.range[0] * self.range[1])

    def noise_at(self, depth: Depth, *, focal: float | None = None) -> Depth:
        """Return the standard deviation of a reading at this depth, in metres.

        Args:
            depth: metres, a number or a tensor.
            focal: focal length in pixels of the images at hand, where it differs from the nominal one.
        """
        return self.noise.sigma(depth, focal or self.focal or 1.0)

    def pitch_at(self, depth: Depth, *, focal: float | None = None) -> Depth:
        """Return the distance in metres of neighboring points on a surface that faces the sensor at this depth.

        A lidar's rays are closer together along a turn than between channels: the wider of the two counts.
        """
        if self.angular_step is not None:
            return depth * math.radians(max(self.angular_step))
        return depth * (1.0 / (focal or self.focal or 1.0))

    def outlier_radius(self, depth: float) -> float:
        """Return the radius in metres within which a surface point has neighbors in spite of noise.

        Three pitches along the surface (28 points when it faces the sensor, 14 when it is tilted by 60 degrees) and
        three standard deviations of the difference of two readings across it.
        """
        return math.hypot(_SIGMAS * self.pitch_at(depth), _SIGMAS * math.sqrt(2.0) * self.noise_at(depth))

    def edge_threshold(self, depth: Depth, *, focal: float | None = None) -> Depth:
        """Return the depth difference of neighboring pixels, in metres, above which they lie on two surfaces.

        What a surface tilted by 80 degrees steps from pixel to pixel, three standard deviations of the difference of
        two readings, and the rounding of both.
        """
        step = _STEEPEST * self.pitch_at(depth, focal=focal)
        return step + _SIGMAS * math.sqrt(2.0) * self.noise_at(depth, focal=focal) + self.depth_step

    def voxel_size(self, depth: float) -> float:
        """Return the finest voxel edge in metres that averages readings rather than repeats their grid.

        Two pitches, so that a voxel on a facing surface holds about four points, or two standard deviations of the
        noise where that is more.
        """
        return max(2.0 * self.pitch_at(depth), 2.0 * self.noise_at(depth))
