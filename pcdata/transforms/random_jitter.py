"""Random changes that are not motions: noise, dropped points, other colors."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from pcdata.contracts.on_host import bounds_of, on_host, uploaded
from pcdata.errors import ConfigError, DTypeError, FrameError
from pcdata.functional.nearest import sum_of_squares
from pcdata.functional.noise import PointStep, dropped_rows, move_points, normal_rows
from pcdata.functional.rows import cloud_of_rows
from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.transforms.base import Params, Transform
from pcdata.transforms.families import SelectTransform
from pcdata.transforms.field_types import Fraction, NonNegative, Positive


class RandomJitter(Transform):
    """Add independent Gaussian noise to every point, in the cloud's unit; ``source_from_cloud`` does not undo it.

    Args:
        sigma: standard deviation per axis; one, or one for each axis of the frame.
        clip: the largest change per axis; None = unlimited.
        along_ray: points move along the line to the viewpoint that saw them, as the error of a depth camera does;
            then sigma and clip are lengths along it.
    """

    is_random = True
    decides_by = "count"

    sigma: NonNegative | tuple[NonNegative, NonNegative, NonNegative] = 0.001
    clip: Positive | None = None
    along_ray: bool = False

    def check_fields(self) -> None:
        """Along the ray there is one direction."""
        if self.along_ray and isinstance(self.sigma, tuple):
            raise ConfigError("RandomJitter: along_ray takes one sigma, the one along the ray")

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Draw a seed per cloud: with it the noise can be drawn again exactly."""
        return {"seed": streams.seeds()}

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Add the noise that belongs to the seeds."""
        if self.is_plain:
            return data.with_fields(points=move_points(data.points, data.ptr, [self.point_step(params)]))
        noise = normal_rows(data.ptr, params["seed"]) * data.points.new_tensor(self.sigma)
        noise = noise if self.clip is None else noise.clamp(-self.clip, self.clip)
        if self.along_ray:
            viewpoint = data.viewpoint_per_point()
            if viewpoint is None:
                raise FrameError(
                    "RandomJitter: along_ray needs to know where the sensor stood: set PointCloud.viewpoint, or leave "
                    "along_ray out"
                )
            ray = data.points - viewpoint
            length = sum_of_squares(ray).sqrt()[:, None]
            noise = ray / torch.where(length > 0, length, 1.0) * noise[:, :1]
        return data.with_fields(points=data.points + noise)

    @property
    def is_plain(self) -> bool:
        """Whether the noise is the same in all directions."""
        return not self.along_ray and not isinstance(self.sigma, tuple)

    def point_step(self, params: Params) -> PointStep:
        """Return the plain noise that belongs to the seeds."""
        assert not isinstance(self.sigma, tuple)  # is_plain
        return params["seed"], self.sigma, self.clip


class RandomPointDropout(SelectTransform):
    """Drop a random fraction of every cloud's points, keeping their order; at least one point stays.

    Args:
        low: smallest part of the points that is dropped.
        high: largest part of the points that is dropped.
    """

    is_random = True
    decides_by = "count"

    low: Fraction = 0.05
    high: Fraction = 0.10

    def check_fields(self) -> None:
        """Require low <= high."""
        if self.low > self.high:
            raise ConfigError(f"RandomPointDropout: low {self.low} exceeds high {self.high}")

    def pick(self, cloud: PointCloud, streams: Streams) -> tuple[Tensor, Tensor]:
        """Draw the part, then which points."""
        keep, ptr = dropped_rows(streams.take(2), on_host(cloud.ptr), self.low, self.high)
        device = cloud.device
        return (keep, ptr) if device.type == "cpu" else (uploaded(keep, device), uploaded(ptr, device))


class RandomColorJitter(Transform):
    """Change brightness, contrast, saturation and hue of every cloud's colors at random, in that order.

    Each factor is drawn once per cloud from [1 - x, 1 + x), the hue shift from [-hue, hue) turns; as torchvision's
    ColorJitter. The adjustments are kornia's.
    """

    is_random = True

    brightness: Fraction = 0.2
    contrast: Fraction = 0.2
    saturation: Fraction = 0.2
    hue: Fraction = 0.05

    def check_fields(self) -> None:
        """Half a turn of hue reaches every hue."""
        if self.hue > 0.5:
            raise ConfigError(f"RandomColorJitter: hue is in turns, at most 0.5, got {self.hue}")

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Draw four numbers per cloud."""
        limits = torch.tensor(
            [self.brightness, self.contrast, self.saturation, self.hue], dtype=torch.float64, device="cpu"
        )
        middle = torch.tensor([1.0, 1.0, 1.0, 0.0], dtype=torch.float64, device="cpu")
        return {"factors": middle + streams.uniform(-1.0, 1.0, 4) * limits}

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Adjust each cloud as an image of one column."""
        if data.colors is None:
            raise DTypeError("RandomColorJitter: the cloud has no colors")
        bounds = bounds_of(data.ptr)
        parts = [
            _adjust(data.colors[start:stop], params["factors"][b])
            for b, (start, stop) in enumerate(itertools.pairwise(bounds))
        ]
        return data.with_fields(colors=torch.cat(parts))


def _adjust(colors: Tensor, factors: Tensor) -> Tensor:
    from kornia.enhance import (  # imported late: kornia is slow to load and only this step needs it
        adjust_brightness_accumulative,
        adjust_contrast_with_mean_subtraction,
        adjust_hue,
        adjust_saturation,
    )

    if not len(colors):
        return colors
    brightness, contrast, saturation, hue = factors.to(colors.device, torch.float32)
    image = colors.T[None, :, :, None]
    image = adjust_brightness_accumulative(image, brightness)
    image = adjust_contrast_with_mean_subtraction(image, contrast)
    image = adjust_saturation(image, saturation)
    image = adjust_hue(image, hue * (2 * torch.pi))
    return image[0, :, :, 0].T.contiguous().clamp(0, 1)


class RandomColorDrop(Transform):
    """Give all points of a cloud one color with a probability: what a model does without colors.

    Args:
        probability: that a cloud loses its colors.
        color: RGB in [0, 1] that they get.

    Source: Qian et al., PointNeXt: Revisiting PointNet++ with improved training and scaling strategies, NeurIPS 2022.
    """

    is_random = True

    probability: Fraction = 0.2
    color: tuple[Fraction, Fraction, Fraction] = (0.0, 0.0, 0.0)

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Draw, per cloud, whether it loses them."""
        return {"dropped": streams.uniform(0.0, 1.0) < self.probability}

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Paint the chosen clouds."""
        if data.colors is None:
            raise DTypeError("RandomColorDrop: the cloud has no colors")
        dropped = params["dropped"].to(data.device)[cloud_of_rows(data.ptr)]
        return data.with_fields(colors=torch.where(dropped[:, None], data.colors.new_tensor(self.color), data.colors))
