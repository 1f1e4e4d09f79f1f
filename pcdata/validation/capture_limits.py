"""The limits of the checks on captures, each with its reason."""

from __future__ import annotations

from dataclasses import dataclass

from pcdata.errors import ConfigError
from pcdata.sensors import sensor_profile
from pcdata.structures.camera import MOST_OFF_CENTER
from pcdata.verdicts import Limits

_TABLE = (0.2, 2.0)  # metres: where the scene of a robot's camera usually is


@dataclass(frozen=True, kw_only=True)
class CaptureLimits(Limits):
    """What a capture keeps that one may train on; the defaults hold for a table as for a room."""

    # Depth that the task is about, (nearest, farthest) in metres; None = nobody has stated it, and no reading is held
    # to it: only the task knows whether a wall at 3 m belongs to it.
    workspace: tuple[float, float] | None = None
    # Metres: what one stored unit of depth of the sensor may be; none = any usual one.
    units: tuple[float, ...] = ()
    # Of a 640x480 image 200,000 readings are usual, and fewer than 100,000 are a coverage problem; as fractions they
    # hold for every resolution.
    valid_fraction: tuple[float, float] = (200_000 / 307_200, 100_000 / 307_200)
    # One region may not miss as much as all holes together may; at half of that it is worth a look.
    missing_region: tuple[float, float] = (0.5 * (1 - 200_000 / 307_200), 1 - 200_000 / 307_200)
    # Most readings should be of the workspace; a third is what coverage demands of the whole image.
    workspace_fraction: tuple[float, float] = (0.5, 100_000 / 307_200)
    # A single depth holds less than 1 in 500 readings of any real scene's end; 1 in 100 makes a false wall.
    saturation: tuple[float, float] = (0.002, 0.01)
    # A voxel or two of a surface may lie at the origin by chance; 1 in 100 points there is an object for a model.
    at_origin: tuple[float, float] = (0.001, 0.01)
    # The farthest point over the usual extent of a cloud. At 10 the rest is a tenth of its size once scaled to a unit
    # sphere; no depth camera sees from 1 to 100 times a distance.
    extent: tuple[float, float] = (10.0, 100.0)
    # Of the image's width or height. Lenses are mounted within 5 %; K of an image resized by 0.8, the smallest usual
    # change of size, is off by 10 %: halfway.
    principal_point: tuple[float, float] = (0.05, MOST_OFF_CENTER)
    # Degrees across the image: depth cameras lie between 40 (long-range stereo) and 110 (wide time of flight).
    field_of_view: tuple[float, float] = (30.0, 120.0)
    # Pixels are square to 1 % in every depth camera; an image resized unevenly differs on purpose, so this warns only.
    pixel_aspect: float = 0.03
    # Pixels: halfway between registered and off by 3, which must be told apart.
    color_shift: float = 1.5
    # Seconds between the views of one capture: half a frame and a whole one at 30 per second.
    sync: tuple[float, float] = (0.0167, 0.0334)

    @classmethod
    def for_sensor(cls, name: str) -> CaptureLimits:
        """Return limits whose workspace is the range of the named sensor, with the units that it stores.

        Raises:
            ConfigError: there is no profile of this name.
        """
        profile = sensor_profile(name)
        return cls(workspace=profile.range, units=profile.metres_per_unit)

    @property
    def workspace_is_stated(self) -> bool:
        """Whether the workspace is that of this scene; the range of a sensor is wider."""
        return self.workspace is not None and not self.units

    @property
    def expected(self) -> tuple[float, float]:
        """Where the scene is expected, in metres: the workspace, or where none is stated, what a robot works on."""
        return _TABLE if self.workspace is None else self.workspace

    def __post_init__(self) -> None:
        super().__post_init__()
        given = self.workspace
        if given is not None and not (isinstance(given, tuple) and len(given) == 2 and 0 < given[0] < given[1]):
            raise ConfigError(
                f"CaptureLimits: workspace must be (near, far) in metres with 0 < near < far, or None, got {given}"
            )
