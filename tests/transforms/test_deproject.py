from __future__ import annotations

import dataclasses

import pytest
import torch

from pcdata.errors import CaptureError, ConfigError, TooFewPointsError
from pcdata.functional.rows import transform_points
from pcdata.structures import PointCloud
from pcdata.synthetic import tabletop
from pcdata.transforms import Deproject, MaskDepth, ToFrame
from tests.factories import frame_with_counts, tabletop_frame


def test_mask_depth_keeps_both_ends_of_the_range_and_blanks_the_rest():
    frame = frame_with_counts((100, 50))
    near, far = float(frame.depth[frame.depth > 0].median()), float(frame.depth.max())
    masked = MaskDepth(near=near, use_mask=False)(frame)
    kept = masked.depth > 0
    assert torch.equal(kept, (frame.depth > 0) & (frame.depth >= near))
    assert torch.equal(masked.depth[kept], frame.depth[kept])
    assert 0 < int(kept.sum()) < 150
    everything = MaskDepth(near=float(frame.depth[frame.depth > 0].min()), far=far, use_mask=False)(frame)
    assert torch.equal(everything.depth, frame.depth)


def test_mask_depth_obeys_the_mask_unless_told_not_to():
    frame = frame_with_counts((100, 50))
    assert torch.equal(MaskDepth()(frame).depth, torch.where(frame.mask, frame.depth, 0.0))
    assert torch.equal(MaskDepth(use_mask=False)(frame).depth, frame.depth)
    without = dataclasses.replace(frame, mask=None)
    assert torch.equal(MaskDepth()(without).depth, frame.depth)
    with pytest.raises(CaptureError, match="MaskDepth: capture 'capture-3' has no mask"):
        MaskDepth(require_mask=True)(without)


def test_mask_depth_drops_labels():
    frame = frame_with_counts((100, 50))
    masked = MaskDepth(use_mask=False, drop_labels=[0, 2])(frame)
    assert set(frame.labels[masked.depth > 0].tolist()) == {-1, 1, 3}
    assert torch.equal(masked.depth > 0, (frame.depth > 0) & (frame.labels != 0) & (frame.labels != 2))
    with pytest.raises(CaptureError, match="has no labels"):
        MaskDepth(drop_labels=[0])(dataclasses.replace(frame, labels=None))


def test_mask_depth_wants_near_below_far():
    with pytest.raises(ConfigError, match="near must be below far"):
        MaskDepth(near=1.0, far=0.5)
    with pytest.raises(ConfigError, match=r"MaskDepth\.near: .*greater than 0.*got -1"):
        MaskDepth(near=-1.0)


def test_every_point_remembers_its_pixel():
    frame = frame_with_counts((120, 0 + 7, 60))
    cloud = Deproject()(frame)
    height, width = frame.size
    assert cloud.counts.tolist() == [120, 7, 60]
    view = cloud.source_index // (height * width)
    row, column = cloud.source_index % (height * width) // width, cloud.source_index % width
    assert torch.equal(view, torch.repeat_interleave(torch.arange(3), cloud.counts))
    assert torch.equal(cloud.points[:, 2], frame.depth[view, row, column])
    assert torch.equal(cloud.colors, frame.colors[view, row, column].float() / 255)
    assert torch.equal(cloud.labels, frame.labels[view, row, column])
    assert torch.equal(cloud.extra["confidence"], frame.confidence[view, row, column])
    # And projects back onto it.
    k = frame.camera.intrinsics[0]
    pixel = cloud.points.double() @ k.T
    torch.testing.assert_close(pixel[:, 0] / pixel[:, 2], column.double(), atol=1e-4, rtol=0)
    torch.testing.assert_close(pixel[:, 1] / pixel[:, 2], row.double(), atol=1e-4, rtol=0)


def test_deprojected_points_lie_on_the_true_surfaces():
    scene = tabletop(3, num_objects=3, num_views=2, size=(60, 80))
    cloud = ToFrame(frame="base")(Deproject()(scene.frame))
    assert float(scene.surface_distance(cloud.points).max()) < 1e-5
    assert torch.equal(cloud.labels, scene.truth.labels.flatten()[cloud.source_index])


def test_the_camera_stands_at_the_origin_and_its_pose_is_kept():
    frame = frame_with_counts()
    cloud = Deproject()(frame)
    assert (cloud.frame_id, cloud.source_frame) == ("camera", "camera")
    assert torch.equal(cloud.viewpoint, torch.zeros(2, 3))
    assert torch.equal(cloud.frames["base"], frame.world_from_camera)
    (camera,) = cloud.meta[1]["cameras"]
    assert camera["view"] == 1
    assert camera["world_from_camera"] == frame.world_from_camera[1].tolist()
    assert (cloud.meta[0]["sample_id"], cloud.meta[0]["capture_index"]) == ("capture-3", 3)


def test_views_deproject_alone_as_together():
    frame = tabletop_frame(num_views=2)
    together = Deproject()(frame).unbatch()
    for view, cloud in enumerate(together):
        alone = Deproject()(frame.view(view))
        assert torch.equal(alone.points, cloud.points)
        assert torch.equal(alone.colors, cloud.colors)
        pixels = frame.size[0] * frame.size[1]
        assert torch.equal(alone.source_index + view * pixels, cloud.source_index)


def test_depth_alone_makes_bare_points():
    frame = frame_with_counts()
    bare = dataclasses.replace(
        frame, colors=None, labels=None, confidence=None, mask=None, world_from_camera=None, frame_id=None
    )
    cloud = Deproject()(bare)
    assert set(cloud.fields()) == {"points", "source_index"}
    assert set(cloud.frames) == {"camera"}


def test_a_view_without_a_reading_is_an_error_that_names_the_capture():
    with pytest.raises(TooFewPointsError, match=r"Deproject: cloud 1 \(sample 'capture-3'\) has no points"):
        Deproject()(frame_with_counts((20, 0)))


def test_the_history_of_the_capture_goes_on_in_every_cloud():
    cloud = Deproject()(MaskDepth(near=0.6)(frame_with_counts()))
    assert isinstance(cloud, PointCloud)
    for steps in cloud.history:
        assert [step["step"] for step in steps] == ["MaskDepth", "Deproject"]
        assert steps[0]["fields"]["near"] == 0.6


def test_depth_is_z_and_not_the_length_of_the_ray():
    scene = tabletop(0, num_objects=0, num_views=1, size=(40, 60), floor=False)
    cloud = Deproject()(scene.frame)
    in_base = transform_points(cloud.points, cloud.ptr, scene.truth.world_from_camera)
    on_top = scene.truth.normals.reshape(-1, 3)[cloud.source_index, 2] > 0.99
    assert int(on_top.sum()) > 100
    assert float(in_base[on_top, 2].abs().max()) < 1e-5
