"""The word ``sensor`` in a configuration becomes the number that the sensor's profile gives."""

from __future__ import annotations

import pytest

from pcdata.build import config_from_yaml
from pcdata.errors import ConfigError
from pcdata.sensors import sensor_profile
from pcdata.transforms import Compose, MaskDepth, RemoveRadiusOutliers, VoxelDownsample

STEPS = """
depth: [MaskDepth: {near: sensor, far: sensor}, Deproject]
cloud: [VoxelDownsample: {voxel_size: sensor}, RemoveRadiusOutliers: {radius: sensor}]
"""


def faults(text: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        config_from_yaml(text, name="c.yaml")
    return str(caught.value).splitlines()


def test_the_steps_hold_the_numbers_of_the_profile():
    pipeline = config_from_yaml("sensor: {name: realsense_d435, depth: 0.6}" + STEPS).pipeline
    profile = sensor_profile("realsense_d435")
    mask, _, voxel, radius = pipeline.steps
    assert isinstance(mask, MaskDepth)
    assert isinstance(voxel, VoxelDownsample)
    assert isinstance(radius, RemoveRadiusOutliers)
    assert (mask.near, mask.far) == profile.range
    assert voxel.voxel_size == pytest.approx(profile.voxel_size(0.6), rel=5e-3)
    assert radius.radius == pytest.approx(profile.outlier_radius(0.6), rel=5e-3)


def test_without_a_depth_the_reference_depth_counts():
    profile = sensor_profile("kinect_v1")
    told = config_from_yaml(f"sensor: {{name: kinect_v1, depth: {profile.reference_depth!r}}}" + STEPS)
    assert config_from_yaml("sensor: kinect_v1" + STEPS).pipeline.fingerprint() == told.pipeline.fingerprint()


def test_another_sensor_or_depth_is_another_fingerprint():
    heads = ["sensor: realsense_d435", "sensor: realsense_d415", "sensor: {name: realsense_d435, depth: 0.5}"]
    assert len({config_from_yaml(head + STEPS).pipeline.fingerprint() for head in heads}) == 3


def test_the_numbers_alone_give_the_same_pipeline():
    pipeline = Compose.from_yaml("sensor: realsense_d455" + STEPS)
    again = Compose.from_yaml(pipeline.to_yaml())
    assert again.fingerprint() == pipeline.fingerprint()
    assert "sensor" not in pipeline.to_yaml()


def test_steps_that_take_a_sensor_may_take_the_one_that_was_named():
    steps = "[MarkUnreliableDepth: {sensor: sensor}, RandomSensorNoise: {sensor: sensor}, Deproject]"
    pipeline = config_from_yaml(f"sensor: kinect_v1\ndepth: {steps}").pipeline
    assert [step.sensor for step in pipeline.steps[:2]] == ["kinect_v1", "kinect_v1"]


def test_a_name_may_still_be_called_sensor():
    pipeline = Compose.from_yaml("- Deproject\n- ToFrame: {frame: sensor}")
    assert pipeline.steps[1].frame == "sensor"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("sensor: realsense_d345", "c.yaml:1:9: unknown sensor 'realsense_d345'; did you mean"),
        ("sensor: [kinect_v1]", "c.yaml:1:9: sensor must be a name that `pcdata profiles` lists (got ['kinect_v1'])"),
        ("sensor: {depth: 1.0}", "c.yaml:1:9: sensor.name: Field required"),
        (
            "sensor: kinect_v1\ncloud: [VoxelDownsample: {unit: normalized, voxel_size: sensor}]",
            "c.yaml:2:57: VoxelDownsample.voxel_size: a sensor's figures are in metres, but unit is 'normalized'",
        ),
        ("sensor: {name: kinect_v1, dept: 1}", "c.yaml:1:27: sensor.dept: no such setting; known: name, depth"),
        ("sensor: {name: kinect_v1, depth: 0}", "c.yaml:1:34: sensor.depth: must be a positive number of metres"),
        ("sensor: {name: kinect_v1, depth: .nan}", "c.yaml:1:34: sensor.depth: must be a positive number of metres"),
        ("sensro: kinect_v1", "c.yaml:1:1: unknown section 'sensro'; did you mean 'sensor'?"),
        (
            "cloud: [VoxelDownsample: {voxel_size: sensor}]",
            "c.yaml:1:39: VoxelDownsample.voxel_size: no sensor is known; name one in the section 'sensor'",
        ),
    ],
)
def test_each_fault_is_told_with_its_place(text: str, expected: str):
    assert faults(text)[0].startswith(expected)


def test_a_field_that_no_profile_gives_says_which_do():
    (line,) = faults("sensor: kinect_v1\ncloud:\n  - RemovePlane: {distance: sensor}")
    assert line.startswith("c.yaml:3:29: RemovePlane.distance: Input should be a valid number (got 'sensor')")
    _, fields = line.split("no sensor profile gives this field, only ")
    assert {"MarkUnreliableDepth.sensor", "MaskDepth.far", "MaskDepth.near"} <= set(fields.split(", "))


def test_an_unknown_sensor_does_not_hide_the_other_faults():
    told = faults("sensor: nothing_like_it\ndepth: [Deprojct]")
    assert [line.split(" ")[0] for line in told] == ["c.yaml:1:9:", "c.yaml:2:9:"]
