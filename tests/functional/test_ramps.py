"""Jumps that a stereo camera smooths into ramps: they are made sharp, and smooth surfaces stay as they are."""

from __future__ import annotations

import torch

from pcdata.functional.touching.limits import KINECT_NOISE, RAMP, Limits
from pcdata.functional.touching.ramps import sharpened
from pcdata.functional.touching.windows import PixelCamera

CAMERA = PixelCamera(600.0, 600.0, 40.0, 30.0)


def smoothed(image: torch.Tensor, width: int) -> torch.Tensor:
    """Average over so many pixels of every row."""
    padded = torch.nn.functional.pad(image[None, None], (width // 2, width // 2, 0, 0), mode="replicate")
    return torch.nn.functional.avg_pool2d(padded, (1, width), stride=1)[0, 0]


def two_levels(far: float, near: float) -> torch.Tensor:
    image = torch.full((60, 80), 1 / far, dtype=torch.float64)
    image[:, 40:] = 1 / near
    return image


def test_a_smoothed_jump_becomes_the_jump_it_was():
    for image in (two_levels(1.2, 0.9), two_levels(0.9, 1.2)):
        ramp = smoothed(image, RAMP - 1)
        assert int((ramp != image).sum()) > 500
        torch.testing.assert_close(sharpened(ramp, CAMERA, KINECT_NOISE, Limits()), image)
        turned = sharpened(ramp.T.contiguous(), CAMERA, KINECT_NOISE, Limits())
        torch.testing.assert_close(turned, image.T)


def test_surfaces_steps_within_the_noise_and_holes_stay():
    row = torch.arange(80, dtype=torch.float64)
    steep = (1 + 0.004 * row).expand(60, 80).contiguous()  # 67 degrees from facing the camera
    long = (0.5 + 0.008 * row).expand(60, 80).contiguous()  # steeper than is followed, but no jump
    low = smoothed(two_levels(1.0, 0.99), 5)
    holed = two_levels(1.2, 0.9)
    holed[:, 38:42] = 0
    for image in (steep, long, low, holed, holed.new_zeros(3, 4), holed.new_ones(1, 1)):
        assert torch.equal(sharpened(image, CAMERA, KINECT_NOISE, Limits()), image)


def test_noise_does_not_keep_a_ramp_from_being_one():
    generator = torch.Generator().manual_seed(0)
    image = two_levels(1.2, 0.8)
    noisy = smoothed(image + KINECT_NOISE * torch.randn(image.shape, generator=generator, dtype=torch.float64), 9)
    found = sharpened(noisy, CAMERA, KINECT_NOISE, Limits())
    before, after = ((one - image).abs() > 0.1 for one in (noisy, found))
    assert int(before.sum()) > 200
    assert int(after.sum()) == 0
