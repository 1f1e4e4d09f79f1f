"""What a stereo depth camera does to a true depth image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import partial

import torch
from torch import Generator, Tensor

from pcdata.errors import ConfigError, ShapeError, near_matches
from pcdata.functional.depth.sensor_noise import draw_sensor_noise, err_in_disparity, facing_depth, sensor_reading


@dataclass(frozen=True, kw_only=True)
class SensorNoise:
    """A stereo depth camera: it errs in disparity, so its depth error grows with the square of the distance.

    ``sigma_z = z^2 * disparity_sigma / (focal * baseline)``; the defaults resemble a short-baseline active stereo
    camera: at 1 m and 615 px focal length, 2.4 mm. Set a field to 0 (or ``max_range`` to inf) to switch its effect off.

    Source: Chang & Chatterjee, Quantization Error Analysis in Stereo Vision, 1992; Keselman et al., Intel RealSense
    Stereoscopic Depth Cameras, 2017.
    """

    disparity_sigma: float = 0.08  # pixels, standard deviation, independent per pixel
    baseline: float = 0.055  # metres between the two imagers
    disparity_step: float = 1.0 / 32.0  # pixels: the matcher's sub-pixel resolution
    depth_step: float = 0.001  # metres: the unit of the depth image on the wire
    min_range: float = 0.2  # metres; nearer reads 0
    max_range: float = 6.0  # metres; farther reads 0
    edge_jump: float = 0.02  # neighbors whose depths differ by more than this part of the nearer one form an edge
    edge_dropout: float = 0.4  # probability that a pixel at an edge reads 0
    dropout: float = 0.005  # probability that any pixel reads 0
    flying_pixels: float = 0.1  # probability that a pixel at an edge reads a mixture of both sides

    def __post_init__(self) -> None:
        for name in ("edge_dropout", "dropout", "flying_pixels"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ConfigError(f"SensorNoise: {name} is a probability, 0..1, got {getattr(self, name)}")
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not value >= 0.0 or (math.isinf(value) and entry.name != "max_range"):
                raise ConfigError(f"SensorNoise: {entry.name} must be finite and at least 0, got {value}")
        if self.baseline == 0.0 or self.edge_jump == 0.0:
            raise ConfigError("SensorNoise: baseline and edge_jump must be more than 0")

    def depth_sigma(self, depth: Tensor, focal: float) -> Tensor:
        """Return the standard deviation in metres that ``disparity_sigma`` causes at this true depth."""
        return depth * depth * self.disparity_sigma / (focal * self.baseline)

    def apply(
        self,
        depth: Tensor,  # (V, H, W) metres, 0 = nothing there
        focal: Tensor,  # (V,) pixels
        generators: Sequence[Generator],  # one CPU generator per view
    ) -> Tensor:  # (V, H, W) float32 metres, 0 = no reading
        """Return the depth image that the sensor would report.

        Raises:
            ShapeError: not one generator and focal length per view.
        """
        if not len(depth) == len(focal) == len(generators):
            raise ShapeError(f"SensorNoise: {len(depth)} views, {len(focal)} focals, {len(generators)} generators")
        truth = depth.double()
        across = facing_depth(truth)
        focal_baseline = focal.double()[:, None, None] * self.baseline
        reading = sensor_reading(
            truth,
            draw_sensor_noise((depth.shape[1], depth.shape[2]), generators, depth.device),
            err=partial(
                err_in_disparity,
                focal_baseline=focal_baseline,
                sigma=self.disparity_sigma,
                step=self.disparity_step,
            ),
            edge=self.edges(truth, across),
            across=across,
            flying_pixels=self.flying_pixels,
            edge_dropout=self.edge_dropout,
            dropout=self.dropout,
            depth_step=self.depth_step,
        )
        outside = (reading < self.min_range) | (reading > self.max_range)
        return torch.where(outside, 0.0, reading).float()

    def edges(self, depth: Tensor, across: Tensor) -> Tensor:
        """Find both sides of every jump: (V, H, W) bool from depths and those of the neighbors that differ most."""
        return (across - depth).abs() > self.edge_jump * torch.minimum(depth, across)


def noise_named(noise: SensorNoise | str | None) -> SensorNoise | None:
    """Return the model that a name stands for: "stereo" = the defaults, "none" or None = a perfect sensor.

    Raises:
        ConfigError: an unknown name.
    """
    presets = {"none": None, "stereo": SensorNoise()}
    if noise is None or isinstance(noise, SensorNoise):
        return noise
    if noise not in presets:
        raise ConfigError(
            f"noise={noise!r}: use a SensorNoise or one of {sorted(presets)}{near_matches(str(noise), presets)}"
        )
    return presets[noise]
