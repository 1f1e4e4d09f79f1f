"""The sensor catalog: complete, sourced, and its derived thresholds hold on surfaces with known noise."""

from __future__ import annotations

import math

import pytest
import torch

from pcdata.errors import ConfigError
from pcdata.functional import radius_outlier_mask
from pcdata.functional.voxels import voxel_downsample
from pcdata.rng import seeded
from pcdata.sensors import PolynomialNoise, SensorProfile, StereoNoise, sensor_profile, sensor_profiles

PROFILES = list(sensor_profiles().values())
CAMERAS = [profile for profile in PROFILES if profile.is_organized]
each = pytest.mark.parametrize("profile", PROFILES, ids=lambda profile: profile.name)
each_camera = pytest.mark.parametrize("profile", CAMERAS, ids=lambda profile: profile.name)


def test_the_sensors_asked_for_are_there():
    assert set(sensor_profiles()) == {
        "realsense_d415", "realsense_d435", "realsense_d435i", "realsense_d455", "realsense_l515", "azure_kinect_nfov",
        "azure_kinect_wfov", "kinect_v1", "photoneo_phoxi_m", "ouster_os1", "velodyne_vlp16", "realsense_d405",
        "realsense_d457", "realsense_d555", "femto_bolt_nfov", "femto_bolt_wfov", "femto_mega_nfov", "zed_2i",
        "oak_d_pro", "zivid_2_plus_m130", "orbbec_gemini_335", "orbbec_gemini_336", "zed_x", "apple_lidar",
        "mech_eye_pro_s",
    }  # fmt: skip
    assert {profile.name for profile in PROFILES if not profile.is_organized} == {"ouster_os1", "velodyne_vlp16"}


FIGURES = ("size", "field_of_view", "focal", "angular_step", "metres_per_unit", "range", "noise", "depth_step")


@each
def test_every_figure_has_a_source(profile: SensorProfile):
    given = [name for name in FIGURES if getattr(profile, name) is not None]
    assert set(profile.sources) == set(given)
    assert all(len(source) > 10 for source in profile.sources.values())
    assert set(profile.estimates) <= set(given)


def test_the_d405_stores_tenths_of_a_millimetre_and_sees_near():
    profile = sensor_profiles()["realsense_d405"]
    assert profile.metres_per_unit[0] == 0.0001
    assert profile.noise_at(0.3) == pytest.approx(0.3**2 * 0.08 / (427 * 0.018))


@pytest.mark.parametrize("name", ["orbbec_gemini_336", "zed_x", "apple_lidar", "mech_eye_pro_s", "zivid_2_plus_m130"])
def test_focal_length_and_field_of_view_tell_of_one_lens(name: str):
    profile = sensor_profiles()[name]
    for pixels, angle in zip(profile.size, profile.field_of_view, strict=True):
        assert profile.focal == pytest.approx(pixels / (2 * math.tan(math.radians(angle / 2))), rel=0.04)


@each
def test_the_figures_are_possible(profile: SensorProfile):
    near, far = profile.range
    assert 0 < near < profile.reference_depth < far
    assert (profile.focal is None) != (profile.angular_step is None)
    assert all(unit > 0 for unit in profile.metres_per_unit)
    assert profile.depth_step >= 0
    for depth in (near, profile.reference_depth, far):
        assert 0 < profile.noise_at(depth) < depth / 4
        assert 0 < profile.pitch_at(depth) < depth / 4


@pytest.mark.parametrize(
    "profile",
    [one for one in CAMERAS if not one.name.startswith(("azure_kinect", "femto"))],  # whose lens distorts: no pinhole
    ids=lambda profile: profile.name,
)
def test_the_nominal_focal_length_agrees_with_the_field_of_view(profile: SensorProfile):
    pinhole = profile.size[1] / 2 / math.tan(math.radians(profile.field_of_view[1] / 2))
    assert profile.focal == pytest.approx(pinhole, rel=0.07)


def test_stereo_error_is_the_derivative_of_depth_by_disparity_times_the_disparity_error():
    noise = StereoNoise(subpixel=0.08, baseline=0.05)
    disparity = torch.tensor(600 * 0.05 / 1.7, dtype=torch.float64, requires_grad=True)
    (600 * 0.05 / disparity).backward()
    assert noise.sigma(1.7, 600.0) == pytest.approx(0.08 * abs(float(disparity.grad)))


def test_the_published_noise_comes_back():
    kinect, lidar_camera = sensor_profile("kinect_v1"), sensor_profile("realsense_l515")
    assert kinect.noise_at(2.0) == pytest.approx(0.0012 + 0.0019 * (2.0 - 0.4) ** 2)  # Nguyen et al. 2012
    # Khoshelham & Oude Elberink 2012 found 1.425e-3 z^2 for another unit: a few millimetres near, 3.6 cm at 5 m.
    assert kinect.noise_at(5.0) == pytest.approx(1.425e-3 * 25, rel=0.2)
    assert [lidar_camera.noise_at(depth) for depth in (1.0, 9.0)] == pytest.approx([0.0025, 0.0155])


@each
def test_tensors_give_what_numbers_give(profile: SensorProfile):
    depths = torch.tensor([0.7, 1.3, 4.0], dtype=torch.float64)
    for method in (profile.noise_at, profile.pitch_at):
        assert method(depths).tolist() == pytest.approx([method(depth) for depth in depths.tolist()])


def test_noise_and_pitch_follow_the_focal_length_of_the_images_at_hand():
    profile = sensor_profile("realsense_d435")
    assert profile.noise_at(1.0, focal=2 * profile.focal) == pytest.approx(profile.noise_at(1.0) / 2)
    assert profile.pitch_at(1.0, focal=2 * profile.focal) == pytest.approx(profile.pitch_at(1.0) / 2)


def _patch(profile: SensorProfile, depth: float, tilt_degrees: float) -> torch.Tensor:
    """What the sensor sees of a plane at this depth: 60 x 60 pixels, with the stated noise."""
    u, v = torch.meshgrid(torch.arange(60.0) - 30, torch.arange(60.0) - 30, indexing="xy")
    slope = math.tan(math.radians(tilt_degrees))
    z = depth / (1 - slope * u / profile.focal)
    z = z + profile.noise_at(z) * torch.randn(z.shape, generator=seeded(0))
    return torch.stack([u * z / profile.focal, v * z / profile.focal, z], dim=-1).reshape(-1, 3)


@each_camera
@pytest.mark.parametrize("tilt", [0.0, 60.0])
def test_the_outlier_radius_keeps_surfaces(profile: SensorProfile, tilt: float):
    depth = profile.reference_depth
    outlier = radius_outlier_mask(_patch(profile, depth, tilt), radius=profile.outlier_radius(depth), min_neighbors=5)
    assert float(outlier.double().mean()) < 0.02


@each_camera
def test_the_voxel_size_averages(profile: SensorProfile):
    points = _patch(profile, profile.reference_depth, 0.0)
    means, _, _ = voxel_downsample(points, voxel_size=profile.voxel_size(profile.reference_depth))
    assert len(means) < len(points) / 1.5


@each_camera
def test_the_edge_threshold_is_not_met_on_a_surface(profile: SensorProfile):
    depth = profile.reference_depth
    z = _patch(profile, depth, 70.0)[:, 2].reshape(60, 60)
    step = (z[:, 1:] - z[:, :-1]).abs()[z[:, 1:] < 1.2 * depth]
    assert float((step > profile.edge_threshold(1.2 * depth)).double().mean()) < 0.01


def test_a_misspelled_sensor_is_told_with_what_was_probably_meant():
    with pytest.raises(ConfigError, match=r"unknown sensor 'realsense_d345'; did you mean .*'realsense_d435'"):
        sensor_profile("realsense_d345")
    with pytest.raises(ConfigError, match=r"unknown sensor 'xyz'; known: realsense_d415, "):
        sensor_profile("xyz")


def test_formulas_are_written_with_their_numbers():
    assert StereoNoise(subpixel=0.08, baseline=0.05).formula == "z^2 * 0.08 px / (focal * 0.05 m)"
    noise = PolynomialNoise(coefficients=(0.0012, 0.0, 0.0019), origin=0.4)
    assert noise.formula == "0.0012 + 0.0019 * (z - 0.4)^2"
    assert PolynomialNoise(coefficients=(0.001, 0.002)).formula == "0.001 + 0.002 * z"
