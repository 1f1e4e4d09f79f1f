from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pcdata.errors import CaptureError, PcdataError, PoseError, UnitError
from pcdata.io import LAYOUTS, open_source, read_depth
from pcdata.structures import DepthFrame, PointCloud
from tests.captures import (
    HEIGHT,
    WIDTH,
    K,
    check_refused_after,
    cloud_files,
    color_of,
    depth_of,
    folder_capture,
    graspnet_frame,
    image,
    seven_scenes_capture,
)
from tests.messages import told


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return folder_capture(tmp_path / "capture")


@pytest.fixture
def scenes(tmp_path: Path) -> Path:
    return seven_scenes_capture(tmp_path / "seq-01")


@pytest.fixture
def clouds(tmp_path: Path) -> Path:
    return cloud_files(tmp_path / "clouds")


# -- detection ---------------------------------------------------------------------------------------------------------


def test_a_folder_of_no_known_layout_lists_what_each_needs_and_what_was_found(tmp_path: Path) -> None:
    (tmp_path / "holiday.txt").write_bytes(b"x")
    with pytest.raises(CaptureError, match=r"found holiday\.txt") as caught:
        open_source(tmp_path)
    assert all(layout.needs in str(caught.value) for layout in LAYOUTS.values())


def test_missing_paths_and_foreign_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="no such file or folder"):
        open_source(tmp_path / "absent")
    (tmp_path / "scan.bag").write_bytes(b"x")
    with pytest.raises(CaptureError, match=r"is called \.bag, but does not begin as"):
        open_source(tmp_path / "scan.bag")


def test_a_path_with_the_signs_of_two_layouts_asks_for_the_kind(scenes: Path, clouds: Path) -> None:
    shutil.copy(clouds / "a.ply", scenes / "mesh.ply")
    with pytest.raises(CaptureError, match="looks like seven_scenes and clouds; say which"):
        open_source(scenes)
    assert open_source(scenes, kind="seven_scenes").kind == "seven_scenes"


def test_naming_the_wrong_kind_says_what_it_needs(tmp_path: Path) -> None:
    for kind in LAYOUTS:
        with pytest.raises(CaptureError, match=r"needs"):
            open_source(tmp_path, kind=kind)


# -- folder ------------------------------------------------------------------------------------------------------------


def test_a_folder_sample_carries_every_file_in_its_place(folder: Path) -> None:
    source = open_source(folder)
    assert source.ids == ["a_1", "a_2", "a_10"]
    frame = source.load("a_10")
    assert isinstance(frame, DepthFrame)
    assert torch.equal(frame.depth[0], read_depth(folder / "depth" / "a_10.png", metres_per_unit=0.001))
    assert frame.colors is not None
    assert np.array_equal(frame.colors[0].numpy(), color_of(1))
    assert frame.labels is not None
    assert frame.labels.unique().tolist() == [1]
    assert frame.mask is not None
    assert int(frame.mask.sum()) == HEIGHT
    assert frame.world_from_camera is not None
    assert frame.world_from_camera[0].tolist() == [[0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]]
    assert (frame.frame_id, frame.capture_index) == ("base", 10)
    assert frame.camera.intrinsics[0].tolist() == [[10, 0, 3.5], [0, 11, 2.5], [0, 0, 1]]


def test_depth_alone_is_enough_and_says_nothing_of_a_world(folder: Path) -> None:
    for name in ("color", "labels", "masks", "poses"):
        shutil.rmtree(folder / name)
    frame = open_source(folder).load("a_1")
    assert isinstance(frame, DepthFrame)
    assert (frame.colors, frame.labels, frame.mask, frame.world_from_camera, frame.frame_id) == (None,) * 5


def test_float_npy_in_metres_and_camera_json_are_read(folder: Path) -> None:
    for name in ("color", "labels", "masks", "poses", "depth"):
        shutil.rmtree(folder / name)
    (folder / "intrinsics.json").unlink()
    (folder / "camera.json").write_text(json.dumps(K))
    (folder / "depth").mkdir()
    np.save(folder / "depth" / "only.npy", np.full((HEIGHT, WIDTH), 0.75, np.float32))
    frame = open_source(folder, metres_per_unit=1.0).load("only")
    assert isinstance(frame, DepthFrame)
    assert frame.depth.unique().tolist() == [0.75]


def test_the_background_label_becomes_none_on_request(folder: Path) -> None:
    frame = open_source(folder, background_label=1).load("a_10")
    assert isinstance(frame, DepthFrame)
    assert frame.labels is not None
    assert frame.labels.unique().tolist() == [-1]


def test_the_unit_must_be_stated_once(folder: Path) -> None:
    with pytest.raises(UnitError, match=r"says metres_per_unit 0\.001, the argument 0\.0002"):
        open_source(folder, metres_per_unit=0.0002)
    (folder / "intrinsics.json").write_text(json.dumps(K))
    with pytest.raises(UnitError, match="the unit of depth must be stated"):
        open_source(folder)
    assert open_source(folder, metres_per_unit=0.001).ids


def break_color_missing(root: Path) -> None:
    (root / "color" / "a_2.png").unlink()


def break_pose_missing(root: Path) -> None:
    (root / "poses" / "a_1.txt").unlink()


def break_depth_missing(root: Path) -> None:
    (root / "depth" / "a_10.png").unlink()


def break_twice(root: Path) -> None:
    np.save(root / "depth" / "a_1.npy", depth_of(0))


def break_foreign(root: Path) -> None:
    (root / "depth" / "a_1.jp2").write_bytes(b"x")


def break_no_depth(root: Path) -> None:
    for file in (root / "depth").iterdir():
        file.unlink()


def break_two_calibrations(root: Path) -> None:
    shutil.copy(root / "intrinsics.json", root / "camera.json")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (break_color_missing, "color is missing for a_2"),
        (break_pose_missing, "pose is missing for a_1"),
        (break_depth_missing, "there is color but no depth for a_10.*there is pose but no depth for a_10"),
        (break_twice, r"a_1\.npy and a_1\.png are both 'a_1'"),
        (break_foreign, r"there is a_1\.jp2"),
        (break_no_depth, "no sample found"),
        (break_two_calibrations, "but both is there"),
    ],
)
def test_an_incomplete_folder_is_refused_when_it_is_opened(
    folder: Path, damage: Callable[[Path], None], message: str
) -> None:
    check_refused_after(damage, folder, message)


def test_hidden_files_do_not_matter(folder: Path) -> None:
    (folder / "depth" / ".DS_Store").write_bytes(b"x")
    (folder / "depth" / "Thumbs.db").write_bytes(b"x")
    assert len(open_source(folder)) == 3


@pytest.mark.parametrize("role", ["color", "labels", "masks"])
def test_an_image_of_another_size_than_its_depth_is_refused(folder: Path, role: str) -> None:
    array = color_of(0, (4, 4)) if role == "color" else np.zeros((4, 4), np.uint8)
    image(folder / role / "a_1.png", array)
    with pytest.raises(CaptureError, match=r"image is 4x4 .* but its depth is 8x6") as caught:
        open_source(folder).load("a_1")
    assert "'a_1'" in told(caught.value)


def test_intrinsics_of_another_resolution_are_refused_with_the_remedy(folder: Path) -> None:
    stated = K | {"width": 16, "height": 12, "cx": 7.5, "cy": 5.5, "metres_per_unit": 0.001}
    (folder / "intrinsics.json").write_text(json.dumps(stated))
    with pytest.raises(CaptureError, match=r"depth is 8x6 .* belong to 16x12 .*Camera\.resized\(\(6, 8\)\)"):
        open_source(folder).load("a_1")


def test_poses_cannot_lead_to_the_camera_they_start_from(folder: Path) -> None:
    (folder / "intrinsics.json").write_text(json.dumps(K | {"metres_per_unit": 0.001, "frame_id": "camera"}))
    with pytest.raises(CaptureError, match="cannot be 'camera'"):
        open_source(folder)


# -- 7-Scenes ----------------------------------------------------------------------------------------------------------


def test_seven_scenes_frames_have_pose_unit_and_both_marks_of_no_reading(scenes: Path) -> None:
    frame = open_source(scenes).load("frame-000020")
    assert isinstance(frame, DepthFrame)
    assert (frame.depth == 0).nonzero().tolist() == [[0, 0, 0], [0, 0, 1]]
    assert float(frame.depth.max()) < 1.5
    assert frame.world_from_camera is not None
    assert frame.world_from_camera[0, 0, 3] == 20
    assert (frame.frame_id, frame.capture_index, frame.camera.size) == ("world", 20, (HEIGHT, WIDTH))


def test_lost_tracking_is_reported_with_the_frame(scenes: Path) -> None:
    (scenes / "frame-000020.pose.txt").write_text("\n".join(["-inf -inf -inf -inf"] * 4))
    source = open_source(scenes)
    source.load("frame-000000")
    with pytest.raises(PoseError, match=r"frame-000020\.pose\.txt.*tracking lost"):
        source.load("frame-000020")


def test_seven_scenes_without_intrinsics_takes_them_as_an_option_only(scenes: Path) -> None:
    with pytest.raises(CaptureError, match="both are given"):
        open_source(scenes, intrinsics=(585, 585, 320, 240))
    (scenes / "camera-intrinsics.txt").unlink()
    with pytest.raises(CaptureError, match=r"neither is there; the data set documents \(585"):
        open_source(scenes)
    frame = open_source(scenes, intrinsics=(10, 11, 3.5, 2.5)).load("frame-000000")
    assert isinstance(frame, DepthFrame)
    assert frame.camera.intrinsics[0].tolist() == [[10, 0, 3.5], [0, 11, 2.5], [0, 0, 1]]


def test_seven_scenes_frames_without_their_partners_are_named(scenes: Path) -> None:
    (scenes / "frame-000020.pose.txt").unlink()
    (scenes / "frame-000040.depth.png").unlink()
    with pytest.raises(CaptureError, match=r"no depth for frame-000040.*pose is missing for frame-000020"):
        open_source(scenes)


# -- GraspNet ----------------------------------------------------------------------------------------------------------


def test_graspnet_meta_becomes_camera_unit_labels_and_object_poses(tmp_path: Path) -> None:
    source = open_source(graspnet_frame(tmp_path / "scene"))
    assert source.ids == ["scene"]
    frame = source.load("scene")
    assert isinstance(frame, DepthFrame)
    assert frame.camera.intrinsics[0].tolist() == [[10, 0, 3.5], [0, 11, 2.5], [0, 0, 1]]
    assert np.array_equal(frame.depth[0].numpy(), (depth_of(1) / 1000).astype(np.float32))
    assert frame.labels is not None
    assert sorted(frame.labels.unique().tolist()) == [-1, 4, 7]
    assert frame.labels[0, 2, 3] == 4
    assert frame.mask is not None
    assert int(frame.mask.sum()) == HEIGHT
    assert frame.provenance["cls_indexes"] == [4, 7]
    assert frame.provenance["camera_from_object"][1] == [[1, 0, 0, 0.1], [0, 1, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]
    assert frame.frame_id is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"intrinsic_matrix": None}, "must have intrinsic_matrix"),
        ({"intrinsic_matrix": np.eye(2)}, "finite numbers of shape"),
        ({"intrinsic_matrix": np.full((3, 3), np.nan)}, "finite numbers of shape"),
        ({"intrinsic_matrix": np.array([[10, 0, 0], [0, 11, 0], [3.5, 2.5, 1]])}, "intrinsic_matrix must be fx"),
        ({"intrinsic_matrix": np.diag([-1.0, 1, 1])}, "focal"),
        ({"factor_depth": np.array([[0]])}, "factor_depth"),
        ({"factor_depth": np.array([[0.001]])}, "at least 1"),
        ({"factor_depth": np.array([[1]])}, r"is metres_per_unit right\?"),
        ({"poses": np.zeros((3, 4, 5))}, r"poses must be \(3, 4, 2\)"),
        ({"poses": np.zeros((3, 4, 2))}, "not rigid"),
        ({"cls_indexes": np.array([[0.5, 1]])}, "whole numbers"),
    ],
)
def test_graspnet_meta_that_cannot_be_true_is_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    source = open_source(graspnet_frame(tmp_path / "scene", **changes))
    with pytest.raises(PcdataError, match=message):
        source.load("scene")


def test_a_damaged_meta_file_is_a_capture_error(tmp_path: Path) -> None:
    root = graspnet_frame(tmp_path / "scene")
    (root / "meta.mat").write_bytes((root / "meta.mat").read_bytes()[:200])
    with pytest.raises(CaptureError, match=r"not a readable MATLAB 5 file|must have"):
        open_source(root).load("scene")


# -- cloud files -------------------------------------------------------------------------------------------------------


def test_a_single_cloud_file_is_a_source_of_one(clouds: Path) -> None:
    for name, count in (("a.ply", 4), ("b.pcd", 5)):
        source = open_source(clouds / name)
        assert source.ids == [name[0]]
        cloud = source.load(name[0])
        assert isinstance(cloud, PointCloud)
        assert (cloud.num_points, cloud.frame_id) == (count, "x")


def test_two_cloud_files_of_one_name_are_refused(clouds: Path) -> None:
    shutil.copy(clouds / "a.ply", clouds / "b.ply")
    with pytest.raises(CaptureError, match=r"b\.pcd and b\.ply are both 'b'"):
        open_source(clouds, kind="clouds")


# -- real captures -----------------------------------------------------------------------------------------------------


def test_the_real_graspnet_frame_has_the_documented_facts(test_data: Path) -> None:
    frame = open_source(test_data / "graspnet_frame").load("graspnet_frame")
    assert isinstance(frame, DepthFrame)
    valid = frame.depth[frame.depth > 0]
    assert frame.size == (720, 1280)
    assert len(valid) == 825_160
    assert (round(float(valid.min()), 3), round(float(valid.max()), 2)) == (0.229, 1.59)
    assert frame.camera.intrinsics[0, 0, 0] == pytest.approx(631.5, abs=0.1)
    assert frame.mask is not None
    assert 0 < int(frame.mask.sum()) < frame.mask.numel()
    assert len(frame.provenance["camera_from_object"]) == len(frame.provenance["cls_indexes"])


def test_the_real_seven_scenes_sequence_has_the_documented_facts(test_data: Path) -> None:
    source = open_source(test_data / "seven_scenes")
    for number in (0, 500, 980):
        frame = source.load(f"frame-{number:06d}")
        assert isinstance(frame, DepthFrame)
        assert frame.capture_index == number
        assert frame.size == (480, 640)
        assert float(frame.depth.max()) < 65
        assert frame.camera.intrinsics[0, 0, 0] == 585


def test_the_real_labeled_clouds_open_as_one_source(test_data: Path) -> None:
    source = open_source(test_data / "osd")
    assert {"learn0", "learn16", "learn44"} <= set(source.ids)
    cloud = source.load("learn0")
    assert isinstance(cloud, PointCloud)
    assert cloud.labels is not None
    assert cloud.meta[0]["organized_size"] == [480, 640]
