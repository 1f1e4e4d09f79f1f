from __future__ import annotations

import dataclasses

import pytest
import torch

from pcdata.errors import ConfigError, FrameError
from pcdata.functional.rows import transform_points
from pcdata.functional.voxels import voxel_downsample
from pcdata.geometry import rigid
from pcdata.structures import PointCloud
from pcdata.synthetic import tabletop
from pcdata.transforms import (
    Center,
    ClusterObjects,
    Compose,
    CropWorkspace,
    Deproject,
    EstimateNormals,
    MergeViews,
    RemovePlane,
    ToFrame,
)
from tests.factories import assert_same, cloud_in_base, cloud_in_camera, frame_with_counts
from tests.transforms.examples import QUARTER_TURN

MATRIX = torch.tensor(QUARTER_TURN, dtype=torch.float64)


def test_to_frame_uses_the_pose_of_each_view():
    cloud = cloud_in_camera((30, 20))
    moved = ToFrame(frame="base")(cloud)
    for before, after in zip(cloud.unbatch(), moved.unbatch()):
        pose = before.frames["base"][0]
        expected = before.points.double() @ pose[:3, :3].T + pose[:3, 3]
        torch.testing.assert_close(after.points.double(), expected, atol=1e-6, rtol=0)
        torch.testing.assert_close(after.viewpoint[0].double(), pose[:3, 3], atol=1e-6, rtol=0)
    assert moved.frame_id == "base"
    torch.testing.assert_close(ToFrame(frame="camera")(moved).points, cloud.points, atol=1e-6, rtol=0)


def test_to_frame_where_the_cloud_is_already_changes_nothing():
    cloud = cloud_in_base()
    torch.testing.assert_close(ToFrame(frame="base")(cloud).points, cloud.points, atol=1e-7, rtol=0)


def test_to_frame_by_a_matrix_teaches_the_cloud_the_new_frame():
    cloud = cloud_in_base((30, 20))
    step = ToFrame(frame="table", start="base", matrix=QUARTER_TURN)
    moved = step(cloud)
    expected = cloud.points.double() @ MATRIX[:3, :3].T + MATRIX[:3, 3]
    torch.testing.assert_close(moved.points.double(), expected, atol=1e-6, rtol=0)
    back = ToFrame(frame="camera")(moved)
    torch.testing.assert_close(back.points, ToFrame(frame="camera")(cloud).points, atol=1e-6, rtol=0)
    with pytest.raises(FrameError, match="given in frame 'base' but the cloud is in 'table'"):
        step(moved)


def test_a_matrix_replaces_the_pose_of_the_capture():
    cloud = cloud_in_camera((30,))
    moved = ToFrame(frame="base", start="camera", matrix=QUARTER_TURN)(cloud)
    torch.testing.assert_close(moved.frames["base"][0], MATRIX)
    torch.testing.assert_close(ToFrame(frame="camera")(moved).points, cloud.points, atol=1e-6, rtol=0)


def test_unknown_frames_are_refused_with_those_known():
    with pytest.raises(
        FrameError,
        match=r"from 'base' to 'world'.*knows the frames \['base', 'camera'\]; name one of them, such as frame: camera",
    ):
        ToFrame(frame="world")(cloud_in_base())
    bare = PointCloud(points=torch.zeros(3, 3), frame_id="camera")
    with pytest.raises(FrameError, match="no pose leads from 'camera' to 'base'"):
        ToFrame(frame="base")(bare)


def test_a_matrix_must_be_rigid_and_have_a_start():
    mirrored = [[-1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]
    with pytest.raises(ConfigError, match=r"ToFrame\.matrix: the pose is a mirror"):
        ToFrame(frame="base", start="camera", matrix=mirrored)
    for fields in ({"matrix": QUARTER_TURN}, {"start": "camera"}):
        with pytest.raises(ConfigError, match="together, or neither"):
            ToFrame(frame="base", **fields)
    assert ToFrame(frame="base", start="camera", matrix=MATRIX).matrix == QUARTER_TURN


# -- merging -------------------------------------------------------------------------------------------------------


def views_in_base(*captures: str, num_views: int = 2) -> PointCloud:
    """Two views of every capture, one after another, in the base frame."""
    parts = []
    for seed, name in enumerate(captures):
        frame = dataclasses.replace(frame_with_counts((60, 40)[:num_views], seed=seed), sample_id=name)
        parts.append(ToFrame(frame="base")(Deproject()(frame)))
    return PointCloud.cat(parts)


def test_merging_drops_the_boundaries_and_keeps_every_row():
    views = views_in_base("a", "b")
    merged = MergeViews()(views)
    assert merged.counts.tolist() == [100, 100]
    assert torch.equal(merged.points, views.points)
    assert torch.equal(merged.source_index, views.source_index)
    assert merged.extra["view"].tolist() == [0] * 60 + [1] * 40 + [0] * 60 + [1] * 40
    assert [entry["sample_id"] for entry in merged.meta] == ["a", "b"]
    assert merged.meta[0]["points_per_view"] == [60, 40]
    assert [camera["view"] for camera in merged.meta[1]["cameras"]] == [0, 1]
    assert (merged.source_frame, merged.frame_id) == ("base", "base")
    assert torch.equal(merged.in_source_frame().points, views.points)


def test_every_point_keeps_the_viewpoint_it_was_seen_from():
    views = views_in_base("a")
    merged = MergeViews()(views)
    assert merged.viewpoint is None
    assert torch.equal(merged.viewpoint_per_point(), views.viewpoint[merged.extra["view"]])
    matrix = MATRIX[None]
    moved = merged.transformed(matrix)
    expected = transform_points(merged.viewpoint_per_point(), merged.ptr, matrix)
    assert torch.equal(moved.viewpoint_per_point(), expected)


def test_merged_captures_equal_each_capture_merged_alone():
    views = views_in_base("a", "b")
    singles = views.unbatch()
    alone = [MergeViews()(PointCloud.cat(singles[:2])), MergeViews()(PointCloud.cat(singles[2:]))]
    assert_same(MergeViews()(views), PointCloud.cat(alone))


@pytest.mark.parametrize("name", ["same", ""])
def test_the_same_capture_twice_in_a_batch_stays_two(name):
    assert MergeViews()(views_in_base(name, name)).counts.tolist() == [100, 100]


def test_captures_of_one_sequence_are_told_apart_by_their_index():
    one, two = (dataclasses.replace(frame_with_counts((30,)), capture_index=i) for i in range(2))
    both = PointCloud.cat([ToFrame(frame="base")(Deproject()(frame)) for frame in (one, two)])
    assert MergeViews()(both).counts.tolist() == [30, 30]


def test_views_from_elsewhere_are_grouped_by_their_sample_id():
    cloud = cloud_in_base((10, 20, 30))
    named = dataclasses.replace(cloud, meta=[{"sample_id": name} for name in "aab"])
    assert MergeViews()(named).counts.tolist() == [30, 30]
    nameless = dataclasses.replace(cloud, meta=[{}, {}, {}])
    with pytest.raises(ConfigError, match=r"views.*sample_id"):
        MergeViews()(nameless)


def test_views_in_their_cameras_frames_are_refused():
    with pytest.raises(FrameError, match=r"still in 'camera'.*add ToFrame"):
        MergeViews()(Deproject()(frame_with_counts()))
    single = Deproject()(frame_with_counts((30,)))
    assert MergeViews()(single).num_points == 30


@pytest.mark.parametrize("num_views", [1, 2])
@pytest.mark.parametrize("step", [RemovePlane(distance=0.2), ClusterObjects(eps=2.0, min_points=2, min_size=2)])
def test_what_was_found_view_by_view_is_refused(num_views, step):
    found = step(views_in_base("a", num_views=num_views))
    with pytest.raises(FrameError, match=f"put {type(step).__name__} after MergeViews"):
        MergeViews()(found)


def test_merged_normals_face_the_camera_that_saw_each_point():
    scene = tabletop(1, num_objects=2, num_views=3, size=(60, 80), floor=False)
    cloud = Compose([Deproject(), ToFrame(frame="base"), MergeViews(), EstimateNormals(radius=0.03)])(scene.frame)
    toward = cloud.viewpoint_per_point() - cloud.points
    assert bool(((toward * cloud.normals).sum(1) > 0).all())
    truth = scene.truth.normals.reshape(-1, 3)[cloud.source_index]
    flat = (truth[:, 2] > 0.999) & (cloud.points[:, 2].abs() < 1e-4)  # the table top
    angle = rigid.angle_between(cloud.normals[flat], truth[flat])
    assert float(angle.median()) < 1e-3


def test_the_history_of_a_merged_cloud_counts_all_its_views():
    frame = tabletop(3, num_objects=2, num_views=2, size=(48, 64)).frame
    views = ToFrame(frame="base")(Deproject()(frame))
    merged = MergeViews()(views)
    steps = {step["step"]: step for step in merged.history[0]}
    assert steps["Deproject"]["points"] == views.num_points
    assert steps["ToFrame"]["points_before"] == steps["ToFrame"]["points"] == views.num_points
    assert len(steps["ToFrame"]["params"]["per_view"]) == 2


def test_normals_are_turned_to_the_camera_that_saw_them():
    views = EstimateNormals(radius=0.05, orient="none")(views_in_base("a", num_views=2))
    merged, as_given = MergeViews()(views), MergeViews(face_cameras=False)(views)
    toward = merged.extra["viewpoint"] - merged.points
    assert bool(((toward * merged.normals).sum(1) >= 0).all())
    assert not bool(((toward * as_given.normals).sum(1) >= 0).all())
    assert bool((merged.normals * as_given.normals).sum(1).abs().gt(0.999).all())


def test_overlap_is_left_to_one_view_per_voxel():
    scene = tabletop(1, num_objects=2, num_views=3, size=(60, 80), floor=False)
    views = ToFrame(frame="base")(Deproject()(scene.frame))
    whole, thinned = MergeViews()(views), MergeViews(voxel_size=0.05)(views)
    assert thinned.num_points < 0.7 * whole.num_points
    _, _, voxel = voxel_downsample(whole.points, voxel_size=0.05)
    kept = torch.isin(whole.source_index, thinned.source_index)
    assert torch.equal(whole.points[kept], thinned.points)
    for one in range(int(voxel.max()) + 1):
        here = voxel == one
        (view,) = whole.extra["view"][here & kept].unique().tolist()
        counts = torch.bincount(whole.extra["view"][here], minlength=3)
        assert int(counts[view]) == int(counts.max()) == int((here & kept).sum())


def test_the_frame_of_the_source_is_known_without_being_listed():
    base = rigid.from_rotation_translation(torch.eye(3, dtype=torch.float64)[None], torch.ones(1, 3).double())
    cloud = PointCloud(points=torch.rand(4, 3), frame_id="camera", frames={"base": base})
    cloud = cloud.with_signal("goal", torch.zeros(1, 3), "position", "base")
    there = ToFrame(frame="base")(cloud)
    assert torch.allclose(there.points, cloud.points + 1)
    assert torch.allclose(ToFrame(frame="camera")(there).points, cloud.points, atol=1e-6)
    matrix = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
    replaced = ToFrame(frame="base", start="camera", matrix=matrix)(cloud)
    assert torch.equal(replaced.signals["goal"], torch.zeros(1, 3))  # in base, as it says, and the cloud is there


def test_a_frame_that_is_nearly_known_is_named() -> None:
    cloud = PointCloud(points=torch.rand(5, 3), frame_id="base")
    with pytest.raises(FrameError, match=r"knows the frames \['base'\]; did you mean 'base'"):
        ToFrame(frame="bsae")(cloud)


def test_an_angle_in_degrees_is_told_to_be_in_radians() -> None:
    with pytest.raises(ConfigError, match=r"max_tilt: .* \(got 20\); it is in radians"):
        RemovePlane(distance=0.01, up=(0, 0, 1), frame="base", max_tilt=20)


def test_what_a_chain_asks_for_makes_it_fit() -> None:
    cloud = PointCloud(points=torch.rand(5, 3), frame_id="base")
    box = CropWorkspace(frame="base", lower=(-9, -9, -9), upper=(9, 9, 9))
    table = ToFrame(frame="table", matrix=torch.eye(4).tolist(), start="base")
    with pytest.raises(ConfigError, match=r"put ToFrame\(frame='base'\) before it"):
        Compose([table, box])
    torch.testing.assert_close(Compose([table, ToFrame(frame="base"), box])(cloud).points, cloud.points)
    with pytest.raises(ConfigError, match="put it before the step that leaves 'base'"):
        Compose([ToFrame(frame="base"), Center(), box])
    assert Compose([ToFrame(frame="base"), box, Center()])(cloud).frame_id == "base/centered"
