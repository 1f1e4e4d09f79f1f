"""FuseTSDF: one capture in, one surface out."""

from __future__ import annotations

import pytest

from pcdata.errors import ConfigError, FrameError, VolumeTooLargeError
from pcdata.sensors import sensor_profile
from pcdata.structures import TSDFVolume
from pcdata.transforms import Compose, CropWorkspace, FuseTSDF, MaskDepth
from tests.factories import frame_with_counts, tabletop_frame


def test_it_gives_what_a_volume_gives():
    frame = tabletop_frame(3)
    volume = TSDFVolume(voxel_size=0.01)
    volume.integrate(frame)
    expected, found = volume.extract_points(), FuseTSDF(frame="base", voxel_size=0.01)(frame)
    assert found.frame_id == "base"
    assert found.points.equal(expected.points)
    assert found.labels.equal(expected.labels)
    assert found.meta[0]["sample_id"] == frame.sample_id


def test_the_cloud_says_the_threshold_and_what_it_dropped():
    frame = tabletop_frame(3)
    whole = FuseTSDF(frame="base", voxel_size=0.01)(frame)
    cloud = FuseTSDF(frame="base", voxel_size=0.01, min_weight=2.0)(frame)
    dropped = whole.num_points - cloud.num_points
    assert dropped > 0
    assert cloud.meta[0]["fusion"] == {"views": 3, "min_weight": 2.0, "dropped": dropped}
    assert int(cloud.extra["num_views"].min()) == 2


def test_it_stands_between_masks_and_crops():
    steps = [MaskDepth(far=1.2), FuseTSDF(frame="base", voxel_size=0.01)]
    steps += [CropWorkspace(frame="base", lower=(-0.3, -0.3, -0.05), upper=(0.3, 0.3, 0.3))]
    cloud = Compose(steps)(tabletop_frame(2))
    assert cloud.num_points > 500
    names = [step["step"] for step in cloud.history[0]]
    assert names == ["MaskDepth", "FuseTSDF", "CropWorkspace"]


def test_the_voxel_size_may_come_from_the_sensor():
    profile = sensor_profile("realsense_d435")
    (step,) = Compose.from_yaml("sensor: realsense_d435\ndepth:\n- FuseTSDF: {frame: base, voxel_size: sensor}\n").steps
    assert step.voxel_size == pytest.approx(profile.voxel_size(profile.reference_depth), rel=0.01)


def test_bad_fields_and_captures_are_refused():
    with pytest.raises(ConfigError, match=r"truncation must be 2 to 64 voxels"):
        FuseTSDF(frame="base", voxel_size=0.01, truncation=0.001)
    with pytest.raises(VolumeTooLargeError, match=r"max_bytes allows 1\.0 MiB"):
        FuseTSDF(frame="base", voxel_size=0.004, max_megabytes=1)(tabletop_frame(2))
    frame = frame_with_counts()
    nowhere = type(frame)(depth=frame.depth, camera=frame.camera)
    with pytest.raises(FrameError, match=r"no world_from_camera"):
        FuseTSDF(frame="base", voxel_size=0.01)(nowhere)
