"""A sensor's errors on clean depth: RandomSensorNoise."""

from __future__ import annotations

import math
import zlib
from dataclasses import replace
from functools import partial
from typing import Annotated

import torch
from annotated_types import Interval
from torch import Tensor

from pcdata.errors import ConfigError
from pcdata.functional.depth.sensor_noise import (
    draw_sensor_noise,
    err_in_disparity,
    facing_depth,
    sensor_reading,
    surface_slope,
)
from pcdata.rng import Streams, child_seed, seeded
from pcdata.sensors import SensorProfile, StereoNoise, sensor_profile
from pcdata.structures import DepthFrame
from pcdata.transforms.base import Params
from pcdata.transforms.families import MaskTransform
from pcdata.transforms.field_types import Fraction, FromSensor, Name, NonNegative


def depth_camera(where: str, name: str) -> SensorProfile:
    """Return the profile of a sensor that gives depth images.

    Raises:
        ConfigError: there is none of this name, or it is a spinning lidar.
    """
    profile = sensor_profile(name)
    if not profile.is_organized:
        raise ConfigError(f"{where}: {name} gives unorganized points, not depth images; name a depth camera")
    return profile


class RandomSensorNoise(MaskTransform):
    """Give clean depth (rendered, or averaged over many frames) the errors of a real depth camera.

    The error follows the sensor's profile at the capture's own focal length: stereo errs in disparity and rounds to its
    disparity step, other kinds err by the profile's standard deviation; then depth is rounded to the sensor's step.
    Where neighboring depths differ by more than the profile's edge threshold, pixels may read nothing or a mixture of
    both surfaces; surfaces tilted beyond ``grazing_degrees`` read nothing. On a real capture the noise comes on top of
    what is there.

    Source: Nguyen et al., Modeling Kinect sensor noise, 2012, for which effects there are; the sizes are the profile's.

    Args:
        sensor: a name that `pcdata profiles` lists.
        strength: times the profile's standard deviation.
        flying_pixels: of the pixels at an edge: they read a mixture of both sides.
        edge_dropout: of the pixels at an edge: they read nothing.
        dropout: of all pixels: they read nothing.
        grazing_degrees: 0 = a surface facing the sensor; 90 = off.
    """

    is_random = True

    sensor: Annotated[Name, FromSensor(lambda sensor, _: sensor.name)]
    strength: NonNegative = 1.0
    flying_pixels: Fraction = 0.1
    edge_dropout: Fraction = 0.4
    dropout: Fraction = 0.005
    grazing_degrees: Annotated[float, Interval(gt=0, le=90)] = 80.0

    def check_fields(self) -> None:
        """Require a depth camera."""
        depth_camera("RandomSensorNoise", self.sensor)

    def make_params(self, data: DepthFrame, streams: Streams) -> Params:
        """Draw a seed: with it the noise can be drawn again exactly."""
        return {"seed": streams.seeds()}

    def told_rows(self, data: DepthFrame, params: Params) -> list[int]:
        """The number of views, rows and columns: the noise is that of pixels."""
        return [zlib.crc32(repr(tuple(data.depth.shape)).encode())]

    def transform(self, data: DepthFrame, params: Params) -> DepthFrame:
        """Return the capture as the sensor would report it."""
        profile = sensor_profile(self.sensor)
        focals = data.camera.intrinsics[:, 0, 0].tolist()
        focal = torch.tensor(focals, dtype=torch.float64, device=data.device)[:, None, None]
        depth = data.depth.double()
        across = facing_depth(depth)
        nearer = torch.where(across > 0, torch.minimum(depth, across), depth)
        thresholds = [profile.edge_threshold(view, focal=one) for view, one in zip(nearer, focals)]
        views = seeded(int(params["seed"][0]))
        reading = sensor_reading(
            depth,
            draw_sensor_noise(data.size, [seeded(child_seed(views)) for _ in focals], data.device),
            err=partial(self._err, profile, focal),
            edge=(across - depth).abs() > torch.stack(thresholds),
            across=across,
            flying_pixels=self.flying_pixels,
            edge_dropout=self.edge_dropout,
            dropout=self.dropout,
            depth_step=profile.depth_step,
        )
        if self.grazing_degrees < 90:
            # Noise that the capture already has must not look like a steep surface.
            noise = torch.stack([profile.noise_at(view, focal=one) for view, one in zip(depth, focals)])
            slope = surface_slope(depth, focal, tolerance=3.0 * math.sqrt(2.0) * noise)
            reading = torch.where(slope > math.tan(math.radians(self.grazing_degrees)), 0.0, reading)
        return replace(data, depth=reading.float())

    def _err(self, profile: SensorProfile, focal: Tensor, depth: Tensor, wobble: Tensor) -> Tensor:
        noise = profile.noise
        if isinstance(noise, StereoNoise):
            return err_in_disparity(
                depth,
                wobble,
                focal_baseline=focal * noise.baseline,
                sigma=self.strength * noise.subpixel,
                step=noise.disparity_step,
            )
        return depth + self.strength * noise.sigma(depth, 1.0) * wobble
