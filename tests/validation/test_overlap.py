import functools
import json
import math
from dataclasses import replace

import pytest
import torch

from pcdata.errors import ConfigError, FrameError, ShapeError, UnitError
from pcdata.geometry import rigid
from pcdata.io import open_source
from pcdata.structures import DepthFrame, PointCloud
from pcdata.synthetic import Miscalibration, tabletop
from pcdata.transforms import Compose, Deproject, MergeViews, ToFrame
from pcdata.validation import OverlapLimits, OverlapResult, verify_overlap
from tests.scenes import overlapping

pytestmark = pytest.mark.usefixtures("patches_fitted_once")


def rig(seed: int, num_views: int = 4, *, millimetres: float = 0.0, degrees: float = 0.0, wrong: int = 0) -> DepthFrame:
    error = Miscalibration(
        translation=[1e-3 * millimetres * (view == wrong) for view in range(num_views)],
        rotation_degrees=[degrees * (view == wrong) for view in range(num_views)],
    )
    true = overlapping(seed, num_views)
    return replace(true.frame, world_from_camera=error.apply(true.truth.world_from_camera, seed))


@functools.cache
def of_true_poses(seed: int, num_views: int) -> OverlapResult:
    return verify_overlap(rig(seed, num_views), names=["left", "right", "top", "front"][:num_views])


def found_wrong(frame: DepthFrame, wrong: int) -> OverlapResult:
    """What is found where one camera, and no other, is named as wrong."""
    found = verify_overlap(frame)
    assert found.verdict == "fail"
    assert found.wrong == (f"camera {wrong}",)
    return found


@pytest.mark.parametrize(("seed", "num_views"), [(0, 3), (2, 4)])
def test_cameras_that_agree_pass(seed, num_views):
    found = of_true_poses(seed, num_views)
    assert found.verdict == "pass"
    assert found.wrong == found.candidates == ()
    assert found.advice == ()
    assert all(pair.median < 0.001 for pair in found.pairs)


@pytest.mark.parametrize(("seed", "num_views", "wrong"), [(0, 3, 0), (2, 4, 3)])
def test_a_camera_shifted_by_6_mm_is_named_with_its_error(seed, num_views, wrong):
    found = found_wrong(rig(seed, num_views, millimetres=6.0, wrong=wrong), wrong)
    assert abs(found.cameras[wrong].shift - 0.006) < 0.001
    assert f"recalibrate camera {wrong}" in found.advice[0]


@pytest.mark.parametrize(("seed", "num_views", "wrong"), [(0, 3, 1), (2, 4, 2)])
def test_a_camera_turned_by_half_a_degree_is_named_with_its_error(seed, num_views, wrong):
    found = found_wrong(rig(seed, num_views, degrees=0.5, wrong=wrong), wrong)
    assert abs(found.cameras[wrong].rotation_degrees - 0.5) < 0.1


def test_a_shift_along_the_table_is_seen_though_the_gap_stays_small():
    clean = rig(2)
    shifted = clean.world_from_camera.clone()
    shifted[2, 0, 3] += 0.006
    found = verify_overlap(replace(clean, world_from_camera=shifted))
    assert all(pair.verdict == "pass" for pair in found.pairs)
    assert found.wrong == ("camera 2",)
    assert found.verdict == "fail"
    torch.testing.assert_close(
        torch.tensor(found.cameras[2].shift_vector), torch.tensor([-0.006, 0.0, 0.0]), atol=1e-3, rtol=0
    )


def test_the_correction_brings_the_camera_back():
    frame = rig(2, millimetres=8.0, degrees=0.6, wrong=1)
    found = verify_overlap(frame)
    better = torch.tensor(found.cameras[1].correction, dtype=torch.float64) @ frame.world_from_camera[1]
    at_scene = better @ rigid.invert_rigid(overlapping(2, 4).truth.world_from_camera[1])
    center = torch.tensor(found.cameras[1].center, dtype=torch.float64)
    assert float((at_scene[:3, :3] @ center + at_scene[:3, 3] - center).norm()) < 0.001


def test_two_cameras_contradict_each_other_and_neither_is_named():
    found = verify_overlap(rig(0, 2, millimetres=8.0))
    assert found.wrong == ()
    assert found.candidates == ("camera 0", "camera 1")
    assert "cannot tell which" in found.advice[0]
    assert all(camera.verdict != "pass" for camera in found.cameras)


def test_a_bare_table_leaves_sliding_and_turning_unmeasurable():
    bare = tabletop(0, 0, 3, noise="stereo", floor=False, size=(240, 320)).frame
    # The table's edges show sides; a camera that sees the middle alone has none.
    depth = torch.zeros_like(bare.depth)
    depth[:, 80:160, 100:220] = bare.depth[:, 80:160, 100:220]
    found = verify_overlap(replace(bare, depth=depth))
    assert found.verdict == "unknown"
    assert all(pair.verdict == "pass" for pair in found.pairs)
    unknown = next(camera for camera in found.cameras if camera.name != found.reference).unmeasurable
    assert sum(text.startswith("shift along") for text in unknown) == 2
    assert any(text.startswith("turn about") for text in unknown)
    assert "upright sides" in found.advice[-1]


def test_gross_errors_fail_though_nothing_is_within_reach():
    frame = rig(0, 3)
    poses = frame.world_from_camera.clone()
    poses[1, 2, 3] += 0.3
    found = verify_overlap(replace(frame, world_from_camera=poses))
    assert found.verdict == "fail"
    assert any("within reach" in line for line in found.advice)


def test_more_captures_of_one_rig_are_more_certain():
    first = overlapping(0, 3)
    poses, camera = first.truth.world_from_camera, first.truth.camera
    second = tabletop(1, 12, noise="stereo", world_from_camera=poses, camera=camera).frame
    one, two = of_true_poses(0, 3), verify_overlap(first.frame, second)
    assert max(found.shift_sigma for found in two.cameras) < max(found.shift_sigma for found in one.cameras)
    assert two.verdict == "pass"
    with pytest.raises(ShapeError, match="capture 1 has other cameras"):
        verify_overlap(first.frame, rig(0, 3, millimetres=5.0))


def test_clouds_on_their_images_give_what_the_frame_gives():
    frame = rig(0, 3, millimetres=7.0, wrong=1)
    cloud = Compose([Deproject(), ToFrame(frame="base")])(frame)
    by_frame, by_cloud = verify_overlap(frame), verify_overlap(cloud)
    assert by_cloud.wrong == by_frame.wrong == ("camera 1",)
    for one, other in zip(by_frame.cameras, by_cloud.cameras, strict=True):
        assert one.shift == pytest.approx(other.shift, abs=2e-4)


def test_bare_clouds_are_compared_by_nearest_neighbors():
    frame = rig(0, 3, millimetres=9.0, wrong=1)
    cloud = replace(Compose([Deproject(), ToFrame(frame="base")])(frame), layout=None)
    found = verify_overlap(cloud)
    assert found.verdict == "fail"
    assert found.wrong == ("camera 1",)
    assert found.pairs[0].meeting is None


def test_a_camera_that_is_far_off_is_named_and_the_others_are_not_blamed():
    """Turned by 40 degrees about the table's normal it finds partners on the table by chance."""
    frame = rig(0, 3)
    cosine, sine = math.cos(math.radians(40)), math.sin(math.radians(40))
    turn = torch.eye(4, dtype=torch.float64)
    turn[:2, :2] = torch.tensor([[cosine, -sine], [sine, cosine]])
    poses = frame.world_from_camera.clone()
    poses[1] = turn @ poses[1]
    found = verify_overlap(replace(frame, world_from_camera=poses))
    assert found.wrong == ("camera 1",)
    assert [camera.name for camera in found.cameras if camera.verdict == "fail"] == ["camera 1"]
    assert "recalibrate camera 1" in found.advice[0]
    json.dumps(found.to_json(), allow_nan=False)


def test_numbers_are_plain_json_and_have_names():
    found = of_true_poses(0, 3)
    plain = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert [camera["name"] for camera in plain["cameras"]] == ["left", "right", "top"]
    assert plain["verdict"] == "pass"
    assert "left - right" in found.text()


def test_limits_decide():
    frame = rig(0, 3, millimetres=4.0, wrong=1)
    assert verify_overlap(frame).verdict == "warn"
    strict = OverlapLimits(shift=(0.001, 0.003))
    assert verify_overlap(frame, limits=strict).verdict == "fail"
    with pytest.raises(ConfigError, match="first <= second"):
        OverlapLimits(shift=(0.005, 0.003))


def test_what_cannot_be_compared_is_refused():
    frame = rig(0, 2)
    with pytest.raises(ConfigError, match="at least one capture"):
        verify_overlap()
    with pytest.raises(ShapeError, match="two views or more"):
        verify_overlap(frame.view(0))
    with pytest.raises(FrameError, match="no world_from_camera"):
        verify_overlap(replace(frame, world_from_camera=None, frame_id=None))
    cloud = Deproject()(frame)
    with pytest.raises(FrameError, match="ToFrame"):
        verify_overlap(cloud)
    merged = Compose([ToFrame(frame="base"), MergeViews()])(cloud)
    with pytest.raises(ShapeError, match="before MergeViews"):
        verify_overlap(merged)
    with pytest.raises(UnitError, match="metres"):
        verify_overlap(replace(ToFrame(frame="base")(cloud), unit="normalized"))
    with pytest.raises(ConfigError, match="one name per camera"):
        verify_overlap(frame, names=["a"])


def test_empty_views_are_not_measurable():
    frame = rig(0, 3)
    depth = frame.depth.clone()
    depth[1] = 0.0
    found = verify_overlap(replace(frame, depth=depth))
    assert found.verdict == "unknown"
    assert {pair.verdict for pair in found.pairs if "camera 1" in (pair.first, pair.second)} == {"unknown"}
    assert math.isinf(found.cameras[1].shift_sigma)
    empty = PointCloud(points=torch.zeros(0, 3), ptr=torch.tensor([0, 0, 0]), frame_id="base")
    assert verify_overlap(empty).verdict == "unknown"


def test_aligning_real_frames_lowers_their_gap(test_data):
    source = open_source(test_data / "seven_scenes")
    one, other = (source.load(source.ids[index]) for index in (0, 1))
    pair = DepthFrame(
        depth=torch.cat([one.depth, other.depth]),
        camera=replace(one.camera, intrinsics=one.camera.intrinsics.repeat(2, 1, 1)),
        world_from_camera=torch.cat([one.world_from_camera, other.world_from_camera]),
        frame_id="world",
    )
    found = verify_overlap(pair)
    moved = torch.tensor(found.cameras[1].correction, dtype=torch.float64) @ pair.world_from_camera[1]
    fixed = torch.tensor(found.cameras[0].correction, dtype=torch.float64) @ pair.world_from_camera[0]
    better = verify_overlap(replace(pair, world_from_camera=torch.stack([fixed, moved])))
    assert better.pairs[0].median < found.pairs[0].median
