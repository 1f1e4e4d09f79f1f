"""Arrays in memory become captures and clouds, or are refused where they would be silently wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pcdata import Camera, DepthFrame, PointCloud, open_source, read_ply, write_capture, write_ply
from pcdata.errors import (
    CaptureError,
    ConfigError,
    DTypeError,
    IntrinsicsError,
    NonFiniteError,
    PcdataWarning,
    PoseError,
    ShapeError,
    UnitError,
)
from pcdata.structures import NORMALIZED
from pcdata.synthetic import tabletop
from tests.factories import assert_same, cloud_in_base

SIZE = (24, 32)
K = np.array([[30.0, 0, 15.5], [0, 31.0, 11.5], [0, 0, 1]])
POSE = np.array([[1.0, 0, 0, 0.1], [0, 0, 1, 0.2], [0, -1, 0, 0.3], [0, 0, 0, 1]])
DEPTH = np.linspace(500, 900, 24 * 32).reshape(SIZE).astype(np.uint16)
COLOR = np.arange(24 * 32 * 3, dtype=np.uint32).reshape(*SIZE, 3).astype(np.uint8)


def frame_of(depth=DEPTH, intrinsics=K, **given) -> DepthFrame:
    return DepthFrame.from_numpy(depth, intrinsics, **({"metres_per_unit": 0.001} | given))


# -- captures ------------------------------------------------------------------------------------------------------


def test_a_capture_of_arrays_is_the_one_that_its_files_hold(tmp_path):
    frame = frame_of(colors=COLOR, world_from_camera=POSE, frame_id="base")
    assert (frame.num_views, frame.size, frame.frame_id) == (1, SIZE, "base")
    assert frame.depth[0, 0, 0] == np.float32(0.5)
    write_capture(frame, str(tmp_path / "capture"))
    source = open_source(str(tmp_path / "capture" / "view0"))
    read = source.load(source.ids[0])
    for name in ("depth", "colors", "world_from_camera"):
        assert torch.equal(getattr(read, name), getattr(frame, name)), name
    assert torch.equal(read.camera.intrinsics, frame.camera.intrinsics)
    assert (tmp_path / "capture" / "view0" / "depth" / "0.png").exists()  # the unit is known, so 16 bits hold it


def test_a_frames_own_arrays_make_the_frame_again():
    frame = replace(tabletop(2, num_views=2, size=SIZE).frame, provenance={}, sample_id="", capture_index=0)
    again = DepthFrame.from_numpy(
        frame.depth.numpy(),
        frame.camera.intrinsics.numpy(),
        colors=frame.colors.numpy(),
        labels=frame.labels.numpy().astype(np.int16),
        world_from_camera=frame.world_from_camera.numpy(),
        frame_id=frame.frame_id,
    )
    assert_same(again, frame)


def test_arrays_are_copied_whatever_their_strides_and_writability():
    depth, bgr = DEPTH.astype(np.float32) / 1000, COLOR[..., ::-1]
    depth.flags.writeable = False
    frame = DepthFrame.from_numpy(depth, K, colors=bgr[..., ::-1])
    assert not np.shares_memory(frame.depth.numpy(), depth)
    assert not np.shares_memory(frame.colors.numpy(), COLOR)
    assert torch.equal(frame.colors[0], torch.from_numpy(COLOR))


def test_what_is_no_reading_becomes_zero():
    depth = DEPTH.astype(np.float64) / 1000
    depth[0, :3] = np.nan, np.inf, 0
    assert frame_of(depth, metres_per_unit=None).depth[0, 0, :4].tolist() == [0, 0, 0, np.float32(depth[0, 3])]
    marked = DEPTH.copy()
    marked[0, 0] = 65535
    assert frame_of(marked, invalid_values=(65535,)).depth[0, 0, 0] == 0
    assert frame_of(np.zeros_like(DEPTH)).depth.sum() == 0  # a covered lens is a capture too


def test_a_mark_that_becomes_points_is_told():
    marked = np.full((64, 64), 700, np.uint16)
    marked[::4] = 65535
    with pytest.warns(PcdataWarning, match="hold 65535"):
        frame_of(marked, Camera.pinhole(fx=60, fy=60, cx=31.5, cy=31.5, size=(64, 64)))


def test_one_matrix_counts_for_all_views_of_one_camera():
    frame = frame_of(np.stack([DEPTH, DEPTH]), K, colors=np.stack([COLOR, COLOR]), distortion=[0.1, 0, 0, 0])
    assert frame.camera.intrinsics.shape == (2, 3, 3)
    assert frame.camera.distortion.shape == (2, 4)


LARGE = Camera.pinhole(fx=60.0, fy=62.0, cx=31.5, cy=23.5, size=(48, 64))


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        ({"metres_per_unit": None}, UnitError, r"uint16 in a unit that nobody states; pass metres_per_unit=0.001"),
        ({"depth": DEPTH.astype(np.int32), "metres_per_unit": None}, UnitError, "nobody states"),
        ({"depth": DEPTH.astype(np.float32), "metres_per_unit": None}, UnitError, "metres_per_unit"),
        ({"depth": DEPTH / 1000}, UnitError, "half of the valid depth is within"),
        ({"metres_per_unit": 1000.0}, UnitError, "above 0 and at most 1"),
        ({"depth": DEPTH.astype(np.uint8)}, DTypeError, "8-bit picture"),
        ({"depth": DEPTH > 0}, DTypeError, "got bool"),
        ({"depth": -(DEPTH / 1000.0), "metres_per_unit": None}, CaptureError, "negative depth"),
        ({"depth": DEPTH.astype(np.int32) * -1}, CaptureError, "negative depth"),
        ({"depth": DEPTH[..., None]}, ShapeError, "ends in channels"),
        ({"depth": DEPTH[0]}, ShapeError, r"depth must be \(H, W\) or \(V, H, W\)"),
        ({"intrinsics": LARGE.intrinsics.numpy()}, IntrinsicsError, "an image of about 64x48"),
        ({"intrinsics": K * [[1.3], [1.0], [1.0]]}, IntrinsicsError, "far from the middle"),
        ({"intrinsics": K / [[32], [24], [1]]}, IntrinsicsError, "far from the middle"),
        ({"intrinsics": LARGE}, IntrinsicsError, r"camera.resized\(\(24, 32\)\)"),
        ({"intrinsics": K.T}, IntrinsicsError, "must be"),
        ({"intrinsics": np.hstack([K, K[:, :1]])}, ShapeError, "projection matrix"),
        ({"intrinsics": [30.0, 31.0, 15.5, 11.5]}, ShapeError, "Camera.pinhole"),
        ({"colors": np.moveaxis(COLOR, -1, 0)}, ShapeError, "channels come last"),
        ({"colors": np.dstack([COLOR, COLOR[..., :1]])}, ShapeError, "alpha"),
        ({"colors": COLOR[..., 0]}, ShapeError, "gray"),
        ({"colors": COLOR[::2, ::2]}, ShapeError, "at the depth's pixels"),
        ({"colors": COLOR / 255.0}, DTypeError, "8-bit RGB"),
        ({"labels": DEPTH / 1.0}, DTypeError, "whole numbers"),
        ({"mask": COLOR[..., 0]}, DTypeError, "mask > 0"),
        ({"confidence": COLOR[..., 0].astype(np.float32)}, DTypeError, "Confidence"),
        ({"world_from_camera": POSE}, CaptureError, "frame_id"),
        ({"world_from_camera": POSE.T, "frame_id": "base"}, PoseError, "transposed"),
        ({"world_from_camera": np.diag([1.0, 1, -1, 1]), "frame_id": "base"}, PoseError, "mirror"),
        ({"world_from_camera": np.diag([2.0, 2, 2, 1]), "frame_id": "base"}, PoseError, "not rigid"),
        ({"world_from_camera": POSE[:3], "frame_id": "base"}, ShapeError, "world_from_camera must be"),
    ],
)
def test_a_capture_that_would_be_silently_wrong_is_refused(given, error, message):
    with pytest.raises(error, match=message):
        frame_of(**given)


def test_the_advice_for_another_image_size_leads_to_the_right_capture():
    frame = frame_of(intrinsics=LARGE.resized(SIZE))
    assert torch.equal(frame.camera.intrinsics, LARGE.resized(SIZE).intrinsics)
    window = frame_of(intrinsics=LARGE.cropped(2, 30, SIZE))
    assert window.camera.is_window
    far_off = K + np.array([[0, 0, 6], [0, 0, 0], [0, 0, 0]])
    assert frame_of(intrinsics=Camera(intrinsics=torch.from_numpy(far_off)[None], size=SIZE)).num_views == 1


# -- clouds --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("counts", [(7,), (3, 0, 5), (1, 1)])
@pytest.mark.parametrize("unit", ["m", NORMALIZED])
def test_a_clouds_own_arrays_make_the_cloud_again(counts, unit):
    cloud = replace(cloud_in_base(counts), unit=unit)
    again = PointCloud.from_numpy(**cloud.numpy(), frame_id="base", kinds=cloud.kinds, unit=unit)
    assert_same(again.fields(), cloud.fields())
    assert torch.equal(again.ptr, cloud.ptr)
    assert torch.equal(again.viewpoint, cloud.viewpoint)
    assert again.kinds == cloud.kinds


def test_arrays_out_share_memory_and_arrays_in_are_copied():
    cloud = cloud_in_base((4,))
    assert np.shares_memory(cloud.numpy()["points"], cloud.points.numpy())
    again = PointCloud.from_numpy(**cloud.numpy(), frame_id="base", kinds=cloud.kinds)
    assert not any(np.shares_memory(again.numpy()[name], value) for name, value in cloud.numpy().items())


def test_arrays_and_files_make_one_cloud(tmp_path):
    points = np.random.default_rng(0).uniform(0, 900, (50, 3))
    arrays = {"points": points, "colors": np.arange(150).reshape(50, 3).astype(np.uint8), "labels": np.arange(50) - 1}
    made = PointCloud.from_numpy(**arrays, frame_id="base", metres_per_unit=0.001)
    write_ply(tmp_path / "a.ply", made)
    assert_same(replace(read_ply(tmp_path / "a.ply"), source_index=None).fields(), made.fields())
    torch.testing.assert_close(made.points.double(), torch.from_numpy(points) / 1000, atol=1e-7, rtol=0)


def test_lengths_follow_the_unit_and_viewpoints_are_per_cloud_or_per_point():
    points = np.full((4, 3), 700, np.int16) + np.arange(4, dtype=np.int16)[:, None]
    given = {"frame_id": "base", "metres_per_unit": 0.001}
    cloud = PointCloud.from_numpy(points, viewpoint=[0, 0, 1000], anchor=points, kinds={"anchor": "position"}, **given)
    assert cloud.viewpoint.tolist() == [[0, 0, 1]]
    assert torch.equal(cloud.extra["anchor"], cloud.points)
    each = PointCloud.from_numpy(points, viewpoint=np.zeros((4, 3)), **given)
    assert each.viewpoint is None
    assert each.viewpoint_per_point().shape == (4, 3)


POINTS = np.random.default_rng(1).uniform(0.1, 0.9, (30, 3))


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        ({"points": (POINTS * 1000).astype(np.int16)}, UnitError, "int16 in a unit that nobody states"),
        ({"points": POINTS * 1000}, UnitError, "metres_per_unit=0.001"),
        ({"points": POINTS * [[np.nan, 1, 1]]}, NonFiniteError, "30 of 30 points"),
        ({"points": POINTS.T}, ShapeError, r"points must be \(N, 3\)"),
        ({"points": POINTS + 1e5, "metres_per_unit": 1.0}, CaptureError, "common offset"),
        ({"points": POINTS.astype(str)}, DTypeError, "points must be numbers"),
        ({"color": POINTS}, DTypeError, "did you mean 'colors'"),
        ({"mass": POINTS[:, 0]}, DTypeError, "'invariant'"),
        ({"colors": POINTS * 255}, CaptureError, "colo.*0..255"),
        ({"colors": POINTS[:7]}, ShapeError, r"colors must be \(30, 3\) for 30 points, got \(7, 3\)"),
        ({"colors": np.hstack([POINTS, POINTS])}, ShapeError, "colors must be"),
        ({"normals": POINTS[:, 0]}, ShapeError, "normals must be"),
        ({"labels": np.arange(60).reshape(30, 2)}, ShapeError, r"labels must be \(30\)"),
        ({"mass": 3.0, "kinds": {"mass": "invariant"}}, ShapeError, "mass must be"),
        ({"labels": POINTS[:, 0]}, CaptureError, "whole numbers"),
        ({"normals": [[object()] * 3] * 30}, DTypeError, "array of numbers"),
        ({"viewpoint": np.zeros((2, 3))}, ShapeError, "viewpoint must be"),
        ({"ptr": [0, 12.0, 30]}, DTypeError, "ptr must be whole"),
        ({"ptr": [0, 12]}, ShapeError, "ptr must end"),
        ({"unit": NORMALIZED, "metres_per_unit": 0.001}, UnitError, "contradicts"),
    ],
)
def test_a_cloud_that_would_be_silently_wrong_is_refused(given, error, message):
    with pytest.raises(error, match=message):
        PointCloud.from_numpy(**({"points": POINTS, "frame_id": "base"} | given))


def test_labels_that_are_true_or_false_are_one_and_zero():
    cloud = PointCloud.from_numpy(np.zeros((3, 3), np.float32), frame_id="base", labels=np.array([True, False, True]))
    assert cloud.labels.tolist() == [1, 0, 1]


def test_an_unknown_kind_is_told_with_those_that_there_are():
    with pytest.raises(ConfigError, match=r"one of position, direction, invariant, minimum, not 'directon'; did you"):
        PointCloud.from_numpy(np.zeros((3, 3)), frame_id="base", a=np.zeros(3), kinds={"a": "directon"})
