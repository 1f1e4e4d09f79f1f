"""RandomSensorNoise has the size that the profile states, at edges what its fields state, and is drawn per sample."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from pcdata.errors import ConfigError
from pcdata.rng import generator_for, seeded
from pcdata.sensors import sensor_profile, sensor_profiles
from pcdata.structures import Camera, DepthFrame
from pcdata.transforms import RandomSensorNoise

QUIET = {"flying_pixels": 0.0, "edge_dropout": 0.0, "dropout": 0.0, "grazing_degrees": 90.0}
CAMERAS = [profile.name for profile in sensor_profiles().values() if profile.is_organized]


def frame_of(depth: torch.Tensor, focal: float = 600.0) -> DepthFrame:
    """A capture of the depth (V, H, W) by pinhole cameras."""
    camera = Camera.pinhole(fx=focal, fy=focal, cx=depth.shape[2] / 2, cy=depth.shape[1] / 2, size=depth.shape[1:])
    camera = dataclasses.replace(camera, intrinsics=camera.intrinsics.repeat(len(depth), 1, 1))
    return DepthFrame(depth=depth.float(), camera=camera)


def plane(depth: float, size: int = 240, views: int = 1) -> DepthFrame:
    return frame_of(torch.full((views, size, size), depth))


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("part", [0.3, 0.9], ids=["near", "far"])
def test_the_standard_deviation_is_the_profiles(name: str, part: float):
    profile = sensor_profile(name)
    depth = profile.range[0] + part * (profile.range[1] - profile.range[0])
    step = RandomSensorNoise(sensor=name, **QUIET)
    error = step(plane(depth), generator=seeded(0)).depth.double() - depth
    rounding = profile.depth_step**2 / 12
    disparity_step = getattr(profile.noise, "disparity_step", 0.0)
    if disparity_step:
        rounding += (profile.noise_at(depth, focal=600.0) * disparity_step / profile.noise.subpixel) ** 2 / 12
    expected = math.sqrt(profile.noise_at(depth, focal=600.0) ** 2 + rounding)
    assert float(error.std()) == pytest.approx(expected, rel=0.05)
    assert abs(float(error.mean())) < 0.1 * expected + expected**2 / depth  # 1 / disparity is convex


def test_stereo_noise_follows_the_captures_own_focal_length():
    step = RandomSensorNoise(sensor="realsense_d435", **QUIET)
    errors = [step(frame_of(torch.full((1, 200, 200), 2.0), focal), generator=seeded(0)).depth for focal in (400, 800)]
    assert float(errors[0].std() / errors[1].std()) == pytest.approx(2.0, rel=0.05)


def test_strength_scales_the_error():
    half, whole = (
        RandomSensorNoise(sensor="realsense_l515", strength=strength, **QUIET)(plane(3.0), generator=seeded(1)).depth
        for strength in (0.5, 1.0)
    )
    assert float(half.std() / whole.std()) == pytest.approx(0.5, rel=0.01)


def test_without_error_only_the_rounding_is_left():
    off = RandomSensorNoise(sensor="kinect_v1", strength=0.0, **QUIET)
    depth = torch.linspace(0.6, 4.0, 100 * 100).reshape(1, 100, 100)
    reading = off(frame_of(depth), generator=seeded(0)).depth
    assert float((reading - depth).abs().max()) <= 0.0005 + 1e-6
    assert float((reading * 1000 - (reading * 1000).round()).abs().max()) < 1e-3


def test_stereo_reads_only_multiples_of_its_disparity_step():
    reading = RandomSensorNoise(sensor="realsense_d435", **QUIET)(plane(2.5), generator=seeded(0)).depth.double()
    disparity = 600 * 0.05 / reading
    # The depth step of 1 mm moves the disparity by up to 600 * 0.05 * 0.0005 / 2.4^2 px.
    assert float((disparity * 32 - (disparity * 32).round()).abs().max()) < 32 * 600 * 0.05 * 0.0005 / 2.4**2 * 1.2


def step_edge() -> DepthFrame:
    """Left half at 1 m, right half at 1.5 m: columns 199 and 200 are the edge."""
    depth = torch.ones(1, 400, 400)
    depth[..., 200:] = 1.5
    return frame_of(depth)


def test_edges_lose_and_mix_the_stated_part_and_nothing_else():
    fields = {**QUIET, "strength": 0.0, "edge_dropout": 0.3, "flying_pixels": 0.5}
    reading = RandomSensorNoise(sensor="realsense_l515", **fields)(step_edge(), generator=seeded(0)).depth[0]
    edge, lost = reading[:, 199:201], reading == 0
    assert float((edge == 0).double().mean()) == pytest.approx(0.3, abs=0.065)  # 4 sigma of 800
    mixed = (edge > 1.001) & (edge < 1.499)
    assert float(mixed.double().mean()) == pytest.approx(0.5 * 0.7, abs=0.07)
    away = torch.cat([reading[:, :199], reading[:, 201:]], dim=1)
    assert not bool(lost[:, :199].any() | lost[:, 201:].any())
    assert not bool(((away > 1.001) & (away < 1.499)).any())


def tilted(degrees: float) -> DepthFrame:
    """A plane through (0, 0, 1 m) turned about the image's vertical axis."""
    slope = math.tan(math.radians(degrees))
    u = (torch.arange(120.0, dtype=torch.float64) - 60) / 600
    return frame_of((1.0 / (1.0 - slope * u)).expand(1, 120, 120).clone())


@pytest.mark.parametrize(("degrees", "is_lost"), [(60.0, False), (75.0, False), (84.0, True)])
def test_grazing_surfaces_read_nothing(degrees: float, is_lost: bool):
    fields = {**QUIET, "strength": 0.0, "grazing_degrees": 80.0}
    reading = RandomSensorNoise(sensor="photoneo_phoxi_m", **fields)(tilted(degrees), generator=seeded(0)).depth
    middle = reading[0, 40:80, 57:63]  # about the axis, where the plane is 1 m away
    assert float((middle == 0).double().mean()) == float(is_lost)


def test_a_facing_plane_of_a_noisy_sensor_is_not_grazing():
    clean = RandomSensorNoise(sensor="realsense_d435", **QUIET)(plane(2.5), generator=seeded(0))
    again = RandomSensorNoise(sensor="realsense_d435", **{**QUIET, "grazing_degrees": 80.0})
    assert float((again(clean, generator=seeded(1)).depth == 0).double().mean()) < 0.001


def test_pixels_without_a_reading_stay_so():
    frame = step_edge()
    depth = frame.depth.clone()
    depth[:, 50:60] = 0
    noisy = RandomSensorNoise(sensor="realsense_d415")(dataclasses.replace(frame, depth=depth), generator=seeded(0))
    assert not bool(noisy.depth[:, 50:60].any())


def test_samples_epochs_and_views_have_noise_of_their_own():
    step = RandomSensorNoise(sensor="realsense_d435")
    frame = plane(1.0, 40, views=2)
    seen = {key: step(frame, generator=generator_for(0, *key)).depth for key in [(0, "a"), (1, "a"), (0, "b")]}
    assert torch.equal(seen[0, "a"], step(frame, generator=generator_for(0, 0, "a")).depth)
    assert not torch.equal(seen[0, "a"], seen[1, "a"])
    assert not torch.equal(seen[0, "a"], seen[0, "b"])
    assert not torch.equal(seen[0, "a"][0], seen[0, "a"][1])
    assert torch.equal(seen[0, "a"][:1], step(plane(1.0, 40), generator=generator_for(0, 0, "a")).depth)


def test_a_lidar_gives_no_depth_images():
    with pytest.raises(ConfigError, match="velodyne_vlp16 gives unorganized points"):
        RandomSensorNoise(sensor="velodyne_vlp16")
    with pytest.raises(ConfigError, match="unknown sensor 'd435'"):
        RandomSensorNoise(sensor="d435")
