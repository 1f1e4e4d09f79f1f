"""Layouts of published data sets: what each stores in a way of its own arrives as metres, poses and names."""

from __future__ import annotations

import json
import pickle
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp

from pcdata import Deproject, open_source, validate_source
from pcdata.errors import CaptureError, ConfigError, IntrinsicsError, PcdataError, PoseError, UnitError
from pcdata.io.sources.synchronized import Trajectory, allow_more, nearest
from pcdata.verdicts import Verdict
from tests import published_captures as made
from tests.published_captures import COLOR_FROM_DEPTH, FAR, INTRINSICS, NEAR, depth_mm, turned
from tests.rlbench_demos import Observation, pickled_demo


def metres(seed: int) -> torch.Tensor:
    return torch.from_numpy((depth_mm(seed) * 0.001).astype(np.float32))


def pose(frame: Any, view: int = 0) -> np.ndarray:
    return frame.world_from_camera[view].numpy()


# -- streams of different rates ----------------------------------------------------------------------------------------


def test_the_nearest_of_another_stream_is_taken_within_a_gap_and_the_rest_is_counted() -> None:
    found = nearest([0.0, 1.0, 2.0, 3.0], [2.9, 0.4, 0.1, 1.9], 0.15)
    assert found.place == {0: 2, 2: 3, 3: 0}
    assert found.apart[1] == pytest.approx(0.6)
    assert (found.unused, found.doubled) == (1, 0)
    assert nearest([0.0, 0.1], [0.05], 1.0).doubled == 1
    assert nearest([1.0], [0.0, 2.0], 1.0).place == {0: 0}, "of two equally near, the earlier"
    assert nearest([1.0], [], 1.0).place == {}


def test_the_gap_that_is_said_to_be_enough_is() -> None:
    for apart in (0.0544, 0.03, 0.0300001, 1.0, 0.999, 12.34, 3e-7):
        (enough,) = re.findall(r"--max-gap (\S+)\)", allow_more("max_gap", apart))
        assert apart < float(enough) <= 1.02 * apart
    assert "nothing to join with" in allow_more("max_gap", float("inf"))


def test_poses_between_two_are_interpolated_as_scipy_does() -> None:
    random = np.random.default_rng(0)
    turns, times = random.normal(size=(6, 4)), np.array([0.0, 0.3, 0.7, 1.5, 1.6, 2.0])
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    shifts = random.normal(size=(6, 3))
    order = random.permutation(6)
    track = Trajectory("test", times[order].tolist(), shifts[order], turns[order])
    for time in (0.0, 0.1, 0.65, 1.55, 2.0):
        expected = Slerp(times, Rotation.from_quat(turns))([time]).as_matrix()[0]
        found = track.pose(time).numpy()
        assert np.abs(found[:3, :3] - expected).max() < 1e-9
        assert found[:3, 3] == pytest.approx([np.interp(time, times, shifts[:, axis]) for axis in range(3)])
    assert track.gap(1.0) == pytest.approx(0.5)
    assert track.gap(2.5) == float("inf")


def test_tum_depth_takes_the_color_nearest_and_the_pose_of_its_moment(tmp_path: Path) -> None:
    source = open_source(made.tum(tmp_path), intrinsics=INTRINSICS)
    frame = source.load("10.000000")
    assert torch.equal(frame.depth[0], metres(0))
    assert frame.provenance["color_seconds_later"] == pytest.approx(0.01)
    half = Rotation.from_euler("z", 45, degrees=True).as_matrix()  # halfway from 0 to 90 degrees
    assert np.abs(pose(frame)[:3, :3] - half).max() < 1e-9
    assert pose(frame)[:3, 3] == pytest.approx([0.5, 0, 0])


def test_tum_leaves_out_and_names_depth_without_partners(tmp_path: Path) -> None:
    late = made.tum(tmp_path / "late", color_late=0.03)
    with pytest.raises(CaptureError, match=r"no color image within 0.02 s, the nearest is 0.03 s off.*max_time_apart"):
        open_source(late, intrinsics=INTRINSICS)
    with pytest.raises(CaptureError, match=r"--max-time-apart 0\.0301\)"):
        open_source(late, intrinsics=INTRINSICS, max_time_apart=0.001)
    assert len(open_source(late, intrinsics=INTRINSICS, max_time_apart=0.0301)) == 3
    short = made.tum(tmp_path / "short", poses="9.95 0 0 0 0 0 0 1\n10.15 2 0 0 0 0 1 0\n")
    source = open_source(short, intrinsics=INTRINSICS, max_time_apart=0.04)
    assert source.ids == ["10.000000", "10.100000"]
    assert "no pose before and after it within 0.2 s" in source.skipped["10.200000"]
    with pytest.raises(IntrinsicsError, match=r"freiburg1.*535\.4"):
        open_source(late)


# -- depth that is stored in a way of its own --------------------------------------------------------------------------


def test_sun3d_bits_are_put_in_order_and_the_newest_poses_are_the_images(tmp_path: Path) -> None:
    source = open_source(made.sun3d(tmp_path))
    frame = source.load(source.ids[2])
    assert torch.equal(frame.depth[0], metres(2))
    assert np.array_equal(pose(frame), turned(2))
    with pytest.raises(CaptureError, match="no sample found"):
        open_source(tmp_path, max_time_apart=0.001)
    made.write(tmp_path / "extrinsics" / "20150101.txt", "1 2 3")
    with pytest.raises(CaptureError, match=r"3 images take 36 numbers.*it has 3"):
        open_source(tmp_path)


def test_nyu_disparity_becomes_metres_by_the_toolbox(tmp_path: Path) -> None:
    source = open_source(made.nyu_raw(tmp_path), intrinsics=INTRINSICS)
    disparity = np.random.default_rng(0).integers(600, 900, made.SIZE)
    expected = 351.3 / (1092.5 - disparity)
    expected[0, 0] = 0  # 2047: no reading
    assert source.load(source.ids[0]).depth[0].numpy() == pytest.approx(expected, rel=1e-6)
    with pytest.raises(IntrinsicsError, match=r"582\.62"):
        open_source(tmp_path)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"P5 8 6 65535\n" + bytes(95), "take 96 bytes, but 95 follow"),
        (b"P5 8 6 255\n" + bytes(48), "must have 16 bits"),
        (b"P5 99999 99999 65535\n", "this one claims 99999x99999"),
        (b"P6 8 6 65535\n" + bytes(96), "does not start as a binary PGM"),
        (b"P5 8 6 65535\n" + bytes(96), "no pixel of 48 has a reading|half of the valid depth"),
    ],
)
def test_a_pgm_that_is_no_depth_is_refused(tmp_path: Path, content: bytes, words: str) -> None:
    source = open_source(made.nyu_raw(tmp_path), intrinsics=INTRINSICS)
    source.files(source.ids[0])["depth"].write_bytes(content)
    if "half" in words:
        source.load(source.ids[0])  # disparity 0 is a third of a metre, as the formula says
        return
    with pytest.raises(CaptureError, match=words):
        source.load(source.ids[0])


def test_rlbench_depth_lies_between_the_planes_and_its_camera_is_turned_upright(tmp_path: Path) -> None:
    source = open_source(made.rlbench(tmp_path))
    frame = source.load("20")
    assert frame.provenance["cameras"] == ["front", "wrist"]
    assert (frame.provenance["metres_per_unit"], frame.provenance["unit_is_recorded"]) == (1.0, True)
    expected = metres(20)
    expected[0, 0] = 0  # nothing was hit
    assert torch.allclose(frame.depth[0], expected, atol=(FAR - NEAR) / 2**24)
    assert frame.camera.intrinsics[0].tolist() == [[10, 0, 4], [0, 11, 3], [0, 0, 1]]
    assert np.array_equal(pose(frame), turned(20) @ np.diag([-1, -1, 1, 1]))
    assert int(frame.labels[0, 1, 1]) == 7 + 256
    assert open_source(tmp_path, camera="wrist").load("0").num_views == 1
    with pytest.raises(ConfigError, match="it has front, wrist"):
        open_source(tmp_path, camera="overhead")


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"front_camera_intrinsics": [[-10, 0, 4], [0, 11, 3], [0, 0, 1]]}, IntrinsicsError, "mirrored image"),
        ({"front_camera_intrinsics": "no"}, CaptureError, "3x3 matrix"),
        ({"front_camera_extrinsics": [[1, 2]] * 21}, CaptureError, "4x4 matrix"),
        ({"front_camera_extrinsics": [[[1e400] * 4] * 4] * 21}, CaptureError, "valid JSON"),
        ({"front_camera_extrinsics": [(2 * np.eye(4)).tolist()] * 21}, PoseError, "not rigid"),
        ({"front_camera_extrinsics": [np.eye(4).tolist()]}, CaptureError, "has 1 poses, but there is depth of step 20"),
        ({"front_camera_far": None}, CaptureError, "front_camera_far must be metres"),
    ],
)
def test_rlbench_metadata_that_cannot_be_are_refused(tmp_path: Path, changes: Any, error: type, words: str) -> None:
    with pytest.raises(error, match=words):
        open_source(made.rlbench(tmp_path, **changes))


def test_rlbench_records_of_the_robot_are_signals(tmp_path: Path) -> None:
    steps = range(21)
    recorded = {
        "gripper_pose": [[0.1 * step, 0, 0, 0, 0, 0, 1] for step in steps],
        "gripper_matrix": [turned(step).tolist() for step in steps],
        "joint_positions": [[float(step)] * 7 for step in steps],
        "gripper_open": [float(step > 10) for step in steps],
        "ragged": [[0.0] * (step % 3) for step in steps],
        "short": [1.0, 2.0],
        "goal_description": "take the steak off the grill",
    }
    path = made.rlbench(tmp_path, **recorded)
    signals = open_source(path).load("20").recorded_signals
    assert {name: (one.kind, one.frame) for name, one in signals.items()} == {
        "gripper_pose": ("pose xyz_quat_xyzw", "world"),
        "gripper_matrix": ("pose matrix", "world"),
        "joint_positions": ("invariant", None),
        "gripper_open": ("invariant", None),
        "task": ("text", None),
    }
    assert signals["gripper_pose"].values.tolist() == [[2.0, 0, 0, 0, 0, 0, 1]]
    stated = {"joint_positions": {"kind": "invariant 7"}, "gripper_matrix": None}
    other = open_source(path, signals=stated).load("20").recorded_signals
    assert other["joint_positions"].kind == "invariant 7"
    assert "gripper_matrix" not in other
    with pytest.raises(ConfigError, match="no stream 'gripper'"):
        open_source(path, signals={"gripper": None})


def test_rlbench_metadata_in_a_pickle_of_arrays_are_those_in_json(tmp_path: Path) -> None:
    path = made.rlbench(tmp_path / "a", gripper_open=[1.0] * 21)
    frame = open_source(path).load("20")
    said = json.loads((path / "meta_data.json").read_text())
    (path / "meta_data.json").unlink()
    arrays = {name: np.array(value) if isinstance(value, list) else value for name, value in said.items()}
    (path / "meta_data.pkl").write_bytes(pickle.dumps(arrays))
    of_arrays = open_source(path).load("20")
    (path / "meta_data.pkl").unlink()
    cameras = {name: value for name, value in arrays.items() if "_camera_" in name}
    observations = [
        Observation(
            gripper_open=1.0,
            misc={name: value[step] if name.endswith("_extrinsics") else value for name, value in cameras.items()},
        )
        for step in range(21)
    ]
    (path / "low_dim_obs.pkl").write_bytes(pickled_demo(observations))
    of_demo = open_source(path).load("20")
    for other in (of_arrays, of_demo):
        assert torch.equal(other.depth, frame.depth)
        assert torch.equal(other.world_from_camera, frame.world_from_camera)
        assert torch.equal(other.camera.intrinsics, frame.camera.intrinsics)
        assert other.recorded_signals["gripper_open"].same_bits(frame.recorded_signals["gripper_open"])


def test_pickled_metadata_of_anything_else_is_never_run_and_the_way_out_is_named(tmp_path: Path) -> None:
    class Hostile:
        def __reduce__(self) -> Any:
            return (Path.touch, (tmp_path / "run",))

    made.rlbench(tmp_path / "episode")
    (tmp_path / "episode" / "meta_data.json").unlink()
    for name in ("meta_data.pkl", "low_dim_obs.pkl"):
        for content in (Hostile(), {"meta": Hostile()}, [], [3], {"_observations": [3]}):
            (tmp_path / "episode" / name).write_bytes(pickle.dumps(content))
            with pytest.raises(
                CaptureError, match=r"write what is needed as JSON|must hold metadata|must be metres|_camera"
            ):
                open_source(tmp_path / "episode")
        (tmp_path / "episode" / name).unlink()
    assert not (tmp_path / "run").exists()


def test_m2t2_metadata_tell_where_the_hand_is_from_json_or_a_pickle(tmp_path: Path) -> None:
    made.pairs(tmp_path)
    (tmp_path / "phoxi.intr").unlink()
    said = {
        "camera_pose": turned(1),
        "intrinsics": np.array(made.MATRIX),
        "ee_pose": turned(2),
        "object_label": "obj_5",
    }
    (tmp_path / "meta_data.pkl").write_bytes(pickle.dumps(said))
    frames = [open_source(tmp_path).load("000")]
    as_json = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in said.items()}
    (tmp_path / "meta_data.json").write_text(json.dumps(as_json))
    frames.append(open_source(tmp_path, frame_id="table").load("000"))
    for frame, name in zip(frames, ("base", "table")):
        assert frame.frame_id == name
        assert frame.recorded_signals["ee_pose"].frame == name
        assert np.array_equal(frame.recorded_signals["ee_pose"].values[0].numpy(), turned(2))


# -- poses and registration --------------------------------------------------------------------------------------------


def test_apc_depth_is_registered_to_the_color_camera_that_the_poses_are_of(tmp_path: Path) -> None:
    source = open_source(made.apc(tmp_path))
    assert source.load("frame-000000").colors is None
    assert any("1 color images, since 1 frames have none" in line for line in source.unread())
    source = open_source(tmp_path, registered=True)
    assert source.skipped == {"frame-000001": "it has no color image"}
    frame = source.load("frame-000000")
    assert torch.equal(frame.depth[0], metres(0))
    assert np.array_equal(pose(frame), turned(0))
    assert float(frame.camera.intrinsics[0, 0, 0]) == 2 * INTRINSICS[0]
    assert frame.colors is not None
    assert frame.provenance["registered_to"] == "color"


def test_apc_poses_lead_to_the_depth_camera_for_the_images_that_it_saw(tmp_path: Path) -> None:
    source = open_source(made.apc(tmp_path), registered=False)
    frame = source.load("frame-000000")
    assert torch.equal(frame.depth[0], metres(5))
    assert pose(frame) == pytest.approx(turned(0) @ COLOR_FROM_DEPTH)
    assert float(frame.camera.intrinsics[0, 0, 0]) == INTRINSICS[0]
    assert frame.colors is None
    shutil.rmtree(tmp_path / "raw")
    beside = open_source(tmp_path, registered=False).load("frame-000000")
    assert torch.equal(beside.depth[0], metres(0))
    assert pose(beside) == pytest.approx(turned(0) @ COLOR_FROM_DEPTH)


@pytest.mark.parametrize("registered", [None, False])
def test_a_missing_depth_to_color_matrix_is_named_and_not_made_up(tmp_path: Path, registered: bool) -> None:
    source = open_source(made.apc(tmp_path, without="Depth-to-color camera extrinsic matrix"), registered=registered)
    frame = source.load("frame-000001")
    assert np.array_equal(pose(frame), turned(1))
    (named,) = frame.provenance["not_needed" if registered is None else "missing"]
    assert "cam.info.txt has no 'Depth-to-color camera extrinsic matrix'" in named
    found = [one for report in validate_source(source) for one in report.findings if one.name == "stated"]
    verdict = Verdict.WARN if registered is None else Verdict.FAIL
    assert all(one.verdict is verdict and "Depth-to-color" in one.found for one in found)
    assert found
    assert "--color-from-depth" in found[0].advice
    given = open_source(tmp_path, registered=registered, color_from_depth=COLOR_FROM_DEPTH.ravel().tolist())
    frame = given.load("frame-000001")
    assert pose(frame) == pytest.approx(turned(1) if registered is None else turned(1) @ COLOR_FROM_DEPTH)
    assert not {"missing", "not_needed"} & {*frame.provenance}


def test_an_apc_matrix_that_is_wrong_is_refused(tmp_path: Path) -> None:
    root = made.apc(tmp_path, without="Depth-to-color camera extrinsic matrix")
    with pytest.raises(ConfigError, match="16 numbers"):
        open_source(root, color_from_depth="no")
    with pytest.raises(PoseError, match="not rigid"):
        open_source(root, color_from_depth=[2.0 * value for value in COLOR_FROM_DEPTH.ravel()])
    with pytest.raises(CaptureError, match="drop one"):
        open_source(made.apc(tmp_path / "whole"), color_from_depth=COLOR_FROM_DEPTH.ravel().tolist())


def test_bop_poses_units_and_intrinsics_are_of_each_image(tmp_path: Path) -> None:
    source = open_source(made.bop(tmp_path))
    for number in (0, 3):
        frame = source.load(f"{number:06d}")
        assert torch.equal(frame.depth[0], metres(number))
        assert np.abs(pose(frame) - turned(number)).max() < 1e-9
        assert float(frame.camera.intrinsics[0, 0, 0]) == 10 + number
    frame = source.load("000000")
    assert frame.labels[0, :2, :2].tolist() == [[5, 5], [5, 5]]
    assert (frame.labels[0, 2:] == -1).all()
    assert frame.provenance["objects"][0]["camera_from_object"][2][3] == pytest.approx(0.7)
    assert (source.load("000003").labels == -1).all()
    assert open_source(tmp_path, labels_from="instance").load("000000").labels[0, 1, 0] == 1
    assert open_source(tmp_path, labels_from="").load("000000").labels is None


def test_a_bop_scene_of_several_cameras_asks_which(tmp_path: Path) -> None:
    made.bop(tmp_path, "_photoneo")
    assert open_source(tmp_path).unread() == []
    made.bop(tmp_path, "_xyz", posed=False)
    with pytest.raises(CaptureError, match=r"holds photoneo, xyz; say which.*--camera photoneo"):
        open_source(tmp_path)
    assert open_source(tmp_path, camera="xyz").load("000000").world_from_camera is None
    assert "camera photoneo" in open_source(tmp_path, camera="xyz").unread()[0]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"depth_scale": 5000.0}, "metres_per_unit"),
        ({"depth_scale": "1"}, "depth_scale must be a number"),
        ({"cam_K": [1, 2]}, "cam_K must be 9 numbers"),
        ({"cam_K": [10, 0, 400, 0, 11, 2.5, 0, 0, 1]}, "lies outside"),
        ({"cam_t_w2c": [1, 2]}, "cam_t_w2c must be 3 numbers"),
        ({"cam_R_w2c": [2, 0, 0, 0, 2, 0, 0, 0, 2]}, "not rigid"),
    ],
)
def test_bop_cameras_that_cannot_be_are_refused(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    file = made.bop(tmp_path) / "scene_camera.json"
    said = json.loads(file.read_text())
    said["0"] |= change
    file.write_text(json.dumps(said))
    with pytest.raises(PcdataError, match=words):
        open_source(tmp_path).load("000000")


def test_scannet_lost_tracking_is_refused_and_color_is_registered_on_request(tmp_path: Path) -> None:
    made.scannet(tmp_path)
    made.write(tmp_path / "pose" / "2.txt", "-inf -inf -inf -inf\n" * 4)
    with pytest.raises(PoseError, match="tracking lost"):
        open_source(tmp_path).load("2")
    source = open_source(tmp_path, skip_refused=True)
    assert source.ids == ["0", "10"]
    assert np.array_equal(pose(source.load("10")), turned(10))
    seen = open_source(tmp_path, registered=True).load("10")
    assert seen.size == (12, 16)
    assert seen.colors is not None


def test_open3d_trajectories_number_the_frames(tmp_path: Path) -> None:
    source = open_source(made.open3d(tmp_path))
    assert np.array_equal(pose(source.load("00002")), turned(2))
    assert source.load("00000").camera.intrinsics[0].tolist() == made.MATRIX
    made.write(tmp_path / "trajectory.log", "0 0 1\n" + made.rows(turned(0)))
    with pytest.raises(CaptureError, match="has 1 poses for 3 depth images"):
        open_source(tmp_path)


# -- images told apart by a word ---------------------------------------------------------------------------------------


def test_names_tell_what_is_depth_color_and_labels(tmp_path: Path) -> None:
    made.pairs(tmp_path)
    np.save(tmp_path / "depth_012.npy", np.ones((*made.SIZE, 1), np.float32))
    made.image(tmp_path / "color_012.png", made.color(12))
    for name in ("segmask_000", "segmask_001", "segmask_010", "segmask_012"):
        made.image(tmp_path / f"{name}.png", np.full(made.SIZE, 255, np.uint8))
    made.image(tmp_path / "depth_vis_000.png", made.color(1))
    made.write(tmp_path / "phoxi_to_world.tf", "phoxi\nworld\n1 2 3\n0 -1 0\n1 0 0\n0 0 1\n")
    source = open_source(tmp_path)
    assert source.ids == ["000", "001", "010", "012"]
    frame = source.load("010")
    assert torch.equal(frame.depth[0], torch.from_numpy((depth_mm(10) / 1000).astype(np.float32)))
    assert (frame.labels == 255).all()
    assert pose(frame)[:3, 3].tolist() == [1, 2, 3]
    assert frame.frame_id == "world"
    assert source.unread() == ["depth_vis_000.png"]
    assert open_source(tmp_path / "depth_001.npy").ids == ["001"]
    with pytest.raises(CaptureError, match="both say them; drop one"):
        open_source(tmp_path, intrinsics=INTRINSICS)


def test_whole_numbers_without_a_unit_are_refused_with_the_units_that_fit(tmp_path: Path) -> None:
    made.image(tmp_path / "NAME_depth.png", np.full((48, 64), 700, np.uint16))
    with pytest.raises(IntrinsicsError, match=r"--intrinsics FX FY CX CY.*metres_per_unit=0\.001.*--metres-per-unit"):
        open_source(tmp_path)
    source = open_source(tmp_path, intrinsics=(60, 60, 31.5, 23.5))
    with pytest.raises(UnitError, match=r"no file states the unit.*metres_per_unit=0\.001 \(half within 0\.7 m\)"):
        source.load("NAME")
    source = open_source(tmp_path, intrinsics=(60, 60, 31.5, 23.5), metres_per_unit=0.001)
    assert float(source.load("NAME").depth.max()) == pytest.approx(0.7)


def test_images_on_another_grid_are_told_and_not_read(tmp_path: Path) -> None:
    made.pairs(tmp_path)
    for number in (0, 1, 10):
        made.image(tmp_path / f"color_{number:03d}.png", made.color(number, (12, 16)))
    source = open_source(tmp_path)
    assert source.load("000").colors is None
    assert "color_000.png has 16x12 pixels, depth 8x6" in source.unread()[0]


def camera_texts(folder: Path) -> tuple[dict[str, Any], type[PcdataError]]:
    """A folder to which a file of a camera is added, how to open it, and what refuses that file."""
    made.pairs(folder)
    (folder / "phoxi.intr").unlink()
    return {}, PcdataError


def time_lists(folder: Path) -> tuple[dict[str, Any], type[PcdataError]]:
    """A folder in which a list of times is replaced, how to open it, and what refuses that list."""
    made.tum(folder)
    return {"intrinsics": INTRINSICS}, CaptureError


@pytest.mark.parametrize(
    ("make", "file", "text", "words"),
    [
        (time_lists, "depth.txt", "10.0 ../../etc/passwd\n", "no file in this folder"),
        (time_lists, "depth.txt", "10.0 depth/10.000000.png extra\n", "must have 2 words, got 3"),
        (time_lists, "depth.txt", "nan depth/10.000000.png\n", "no time in seconds"),
        (time_lists, "rgb.txt", "1e300 rgb/10.010000.png\n", "no time in seconds"),
        (time_lists, "groundtruth.txt", "10 0 0 0 0 0 0 2\n", "is no rotation, its length is 2"),
        (time_lists, "groundtruth.txt", "10 0 0 0 0 0 0 1\n10 1 0 0 0 0 0 1\n", "two poses are of the time"),
        (time_lists, "groundtruth.txt", "10 a 0 0 0 0 0 1\n", "must hold numbers"),
        (camera_texts, "phoxi.intr", "{}", "is not as files of this name are"),
        (camera_texts, "phoxi.intr", '{"_fx": 1e999}', "not valid JSON"),
        (camera_texts, "x_to_y.tf", "a\nb\n1 2\n", "is not as files of this name are"),
        (camera_texts, "x_to_y.tf", "a\nb\n1 2 3\n2 0 0\n0 2 0\n0 0 2\n", "not rigid"),
        (camera_texts, "camera_intrinsics.yaml", "fx: &a [*a]\n", "is not as files of this name are"),
        (camera_texts, "intrinsics.txt", "1 2 3", "nine numbers, got 3"),
        (camera_texts, "intrinsics.txt", "Intrinsic of nothing", 'names no intrinsics of the stream "Depth"'),
        (camera_texts, "camera.json", '{"intrinsic_matrix": [1], "width": 8, "height": 6}', "3x3 matrix"),
        (camera_texts, "meta_data.json", '{"camera_pose": [[1]], "intrinsics": 3}', "12 or 16 numbers"),
    ],
)
def test_lists_of_times_and_files_of_cameras_that_cannot_be_are_refused(
    tmp_path: Path, make: Callable[[Path], tuple[dict[str, Any], type[PcdataError]]], file: str, text: str, words: str
) -> None:
    options, error = make(tmp_path)
    made.write(tmp_path / file, text)
    with pytest.raises(error, match=words):
        open_source(tmp_path, **options)


# -- recordings of an Azure Kinect -------------------------------------------------------------------------------------


def test_an_azure_kinect_recording_has_the_intrinsics_of_its_mode(tmp_path: Path) -> None:
    source = open_source(made.azure_kinect(tmp_path).parent)
    assert source.ids == ["000000", "000001"]
    frame = source.load("000001")
    assert (frame.depth == torch.tensor(801 * 0.001, dtype=torch.float32)).all()
    (fx, _, cx), (_, _, cy), _ = frame.camera.intrinsics[0].tolist()
    assert (fx, cx, cy) == pytest.approx((0.49 * 512, 256 - 96 - 0.5, 256 - 90 - 0.5))
    assert frame.camera.is_window  # its center is 12 of 288 rows from that of the sensor
    k1, k2, p1, p2, k3, k4, k5, k6 = frame.camera.distortion[0].tolist()
    assert [k1, k2, k3, k4, k5, k6, 0, 0, p2, p1] == made.K4A_LENS[4:]
    assert frame.provenance["serial"] == "0123"
    assert "track COLOR; registered=True" in source.unread()[0]


def test_of_a_recording_that_is_cut_short_the_whole_frames_are_read(tmp_path: Path) -> None:
    path = made.azure_kinect(tmp_path)
    path.write_bytes(path.read_bytes()[:-200])
    source = open_source(path)
    assert [float(source.load(name).depth.max()) for name in source.ids] == pytest.approx([0.8])


@pytest.mark.parametrize("keep", [3, 100, 3000])
def test_a_recording_that_is_cut_short_is_a_typed_error(tmp_path: Path, keep: int) -> None:
    path = made.azure_kinect(tmp_path)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(CaptureError):
        [source.load(name) for source in [open_source(path, kind="azure_kinect")] for name in source.ids]


# -- links -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(set(made.CAPTURES) - {"azure_kinect"}))
def test_a_file_that_is_a_link_out_of_the_capture_is_not_read(name: str, tmp_path: Path) -> None:
    root = made.CAPTURES[name](tmp_path / "capture")
    options = made.OPTIONS.get(name, {})
    source = open_source(root, kind=name, **options)
    depth = source.depth_files(source.ids[0])[0]
    outside = tmp_path / "outside"
    outside.mkdir()
    depth.rename(outside / depth.name)
    depth.symlink_to(outside / depth.name)
    with pytest.raises(CaptureError, match="leads out of"):
        open_source(root, kind=name, **options).load(source.ids[0])
    allowed = open_source(root, kind=name, links_to=str(outside), **options)
    assert allowed.load(source.ids[0]).depth.max() > 0
    assert Deproject()(allowed.load(source.ids[0])).num_points > 0
