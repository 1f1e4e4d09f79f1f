"""Files of robosuite and ManiSkill: what each stores in its own way arrives as metres, poses, signals and episodes."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch

from pcdata import Calibration, Camera, open_source, validate_source
from pcdata.errors import CaptureError, ConfigError, IntrinsicsError, PcdataError, PoseError
from pcdata.io.calibration.mujoco_model import read_mujoco_model
from pcdata.io.sources.capture_source import signals_of
from pcdata.verdicts import Verdict
from tests import simulated_captures as made
from tests.published_captures import color, depth_mm
from tests.simulated_captures import camera_pose, maniskill, metres, robomimic

RAW = {"depth_values": "z_buffer", "rows": "bottom_first"}
# Of every image 10 x 8 pixels: robosuite's middle, width / 2, counts from the corner of the first pixel.
CENTERED = [[10.0, 0, made.WIDTH / 2 - 0.5], [0, 10.0, made.HEIGHT / 2 - 0.5], [0, 0, 1]]


def changed(path: Path, change: Callable[[Any], None]) -> Path:
    with h5py.File(path, "r+") as file:
        change(file)
    return path


# -- robosuite ---------------------------------------------------------------------------------------------------------


def test_what_robomimic_extracted_opens_without_an_option(tmp_path: Path) -> None:
    source = open_source(robomimic(tmp_path))
    assert source.ids == [f"demo_{number}_{step:06d}" for number in (0, 10) for step in range(3)]
    frame = source.load("demo_10_000002")
    assert torch.equal(frame.depth[0], torch.from_numpy(metres(12)))
    assert np.array_equal(frame.colors[0].numpy(), color(12))
    assert frame.camera.intrinsics[0].tolist() == CENTERED
    assert frame.world_from_camera[0].numpy() == pytest.approx(camera_pose(1))
    assert (frame.labels == 4).all()
    assert frame.provenance["cameras"] == ["agentview"]
    assert frame.provenance["timestamps"] == [0.1]
    (told,) = source.unread()
    assert "camera robot0_eye_in_hand: its poses are not in the file" in told


def test_the_camera_on_a_hand_is_read_alone_and_its_missing_pose_is_named(tmp_path: Path) -> None:
    source = open_source(robomimic(tmp_path), camera="robot0_eye_in_hand")
    frame = source.load(source.ids[0])
    assert frame.world_from_camera is None
    assert "robot0_eef_pose" not in frame.recorded_signals
    assert any("signals robot0_eef_pose" in told for told in source.unread())
    found = [one for report in validate_source(source) for one in report.findings if one.name == "stated"]
    assert found
    assert all(one.verdict is Verdict.FAIL and "robot0_eye_in_hand" in one.found for one in found)
    camera = Camera.pinhole(fx=10, fy=10, cx=3.5, cy=2.5, size=made.SIZE)
    pose = torch.from_numpy(camera_pose(2))
    known = Calibration(cameras={"robot0_eye_in_hand": camera}, transforms={"base_from_robot0_eye_in_hand": pose})
    both = open_source(tmp_path / "demo.hdf5", camera="robot0_eye_in_hand", calibration=known, frame_id="base")
    assert torch.equal(both.load(both.ids[0]).world_from_camera[0], pose)
    named = open_source(tmp_path / "demo.hdf5", frame_id="base")
    assert named.load(named.ids[0]).recorded_signals["robot0_eef_pose"].frame == "base"


def test_observations_are_signals_and_the_two_halves_of_a_pose_are_one(tmp_path: Path) -> None:
    source = open_source(robomimic(tmp_path))
    signals = source.load("demo_0_000001").recorded_signals
    kinds = {name: (signal.kind, signal.frame) for name, signal in signals.items()}
    assert kinds == {
        "robot0_eef_pose": ("pose xyz_quat_xyzw", "world"),
        **dict.fromkeys(("robot0_joint_pos", "action", "reward", "done", "states"), ("invariant", None)),
        "task": ("text", None),
    }
    assert signals["robot0_eef_pose"].values.tolist() == [[0.1, 0.2, 0.3, 0.0, 0.0, 1.0, 0.0]]
    assert signals["action"].values.tolist() == [[(7 + n) / 8 for n in range(7)]]
    assert signals["task"].values == ("lift the cube",)
    assert (float(signals["reward"].values), bool(signals["done"].values)) == (0.5, False)
    alone = signals_of(source, "demo_0_000001")
    assert all(alone[name].same_bits(signal) for name, signal in signals.items())
    stated = {
        "action": {"kind": "delta_pose xyz_axis_angle + invariant 1", "frame": "world"},
        "states": None,
        "task": None,
    }
    other = open_source(tmp_path / "demo.hdf5", signals=stated).load("demo_0_000001").recorded_signals
    assert other["action"].kind == "delta_pose xyz_axis_angle + invariant 1"
    assert {"states", "task"}.isdisjoint(other)
    with pytest.raises(ConfigError, match=r"no stream 'actions'.*did you mean 'action'"):
        open_source(tmp_path / "demo.hdf5", signals={"actions": None})


def test_demonstrations_are_episodes_with_the_times_of_the_controller(tmp_path: Path) -> None:
    first, second = open_source(robomimic(tmp_path)).episodes
    assert (first.id, first.first, first.length) == ("demo_0", 0, 3)
    assert (second.id, second.first, second.times) == ("demo_10", 3, (0.0, 0.05, 0.1))
    assert second.attributes == {"env_name": "Lift", "env_version": "1.4.1"}


def test_observations_of_robosuite_are_a_buffer_with_the_bottom_row_first_once_that_is_said(tmp_path: Path) -> None:
    path = robomimic(tmp_path, raw=True)
    with pytest.raises(
        ConfigError, match=r"depth is metres .* or a buffer .* and which row .* --depth-values z_buffer"
    ):
        open_source(path)
    with pytest.raises(ConfigError, match=r"nothing says which row"):
        open_source(path, depth_values="z_buffer")
    frame = open_source(path, **RAW).load("demo_0_000001")
    expected = torch.from_numpy(metres(1))
    expected[0, 0] = 0  # the far plane
    assert torch.equal(frame.depth[0] == 0, expected == 0)
    # A float32 share near 0.98 is right to 3e-8, which is z^2 / near times that.
    assert (frame.depth[0] - expected).abs().max() < 1.5e-5
    assert np.array_equal(frame.colors[0].numpy(), color(1))
    assert frame.camera.intrinsics[0].numpy() == pytest.approx(np.array(CENTERED))
    assert frame.world_from_camera[0, :3, 3].tolist() == [0.5, 0, 1.35]
    forward = frame.world_from_camera[0, :3, 2]  # the quaternion of robosuite's agentview looks down and ahead
    assert float(forward[2]) < -0.5
    assert frame.provenance["near_far"] == [0.02, 20.0]


def test_planes_and_rows_come_from_attributes_or_are_asked_for(tmp_path: Path) -> None:
    bare = made.MODEL.replace('<statistic extent="2"/>', "")
    path = robomimic(tmp_path, raw=True, model=bare)
    with pytest.raises(
        CaptureError, match=r"needs the planes .* 0 < near < far.*znear and zfar times the model's extent"
    ):
        open_source(path, **RAW).load("demo_0_000000")
    by_option = open_source(path, **RAW, near=made.NEAR, far=made.FAR).load("demo_0_000000")

    def state(file: Any) -> None:
        file["data"].attrs["image_convention"] = "opengl"
        for demo in file["data"].values():
            demo.attrs.update({"extent": 2.0, "znear": 0.01, "zfar": 10.0})

    by_attribute = open_source(changed(path, state), depth_values="z_buffer").load("demo_0_000000")
    assert torch.equal(by_attribute.depth, by_option.depth)


def test_intrinsics_that_nothing_says_are_asked_for_by_the_name_of_the_camera(tmp_path: Path) -> None:
    path = changed(
        robomimic(tmp_path, raw=True), lambda file: [demo.attrs.pop("model_file") for demo in file["data"].values()]
    )
    with pytest.raises(IntrinsicsError, match=r"camera 'agentview'.*--camera agentview --intrinsics FX FY CX CY"):
        open_source(path, **RAW, near=0.02, far=20.0)
    with pytest.raises(ConfigError, match="intrinsics are of one camera"):
        open_source(path, **RAW, intrinsics=(10, 10, 3.5, 2.5))
    said = {"camera": "agentview", "intrinsics": (10, 10, 3.5, 2.5), "near": 0.02, "far": 20.0}
    assert open_source(path, **RAW, **said).load("demo_0_000000").world_from_camera is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f["data"].attrs.__setitem__("env_args", "[1]"), "env_args"),
        (lambda f: f["data/demo_0"].attrs.__setitem__("camera_info", "{"), "camera_info"),
        (lambda f: f["data/demo_0"].attrs.__setitem__("camera_info", '{"agentview": 3}'), "intrinsics and extrinsics"),
        (lambda f: f["data/demo_0"].attrs.__setitem__("camera_info", np.arange(3)), "must be one text"),
        (lambda f: f["data/demo_10"].pop("obs"), "demo_10 has depth of no camera"),
        (
            lambda f: _replace(f, "data/demo_0/obs/agentview_depth", np.ones((2, 6, 8, 1), np.float32)),
            "different numbers",
        ),
        (lambda f: _link(f, "data/demo_0/obs/agentview_depth"), "demo_10 has depth of|has no depth|no view"),
        (lambda f: _replace(f, "data/demo_0/obs/agentview_depth", np.ones((3, 6, 8, 2), np.float32)), "one channel"),
        (lambda f: _replace(f, "data/demo_0/obs/agentview_image", np.ones((3, 6, 8, 3), np.float32)), "uint8"),
        (lambda f: _replace(f, "data/demo_0/actions", np.ones((0, 7))), "no row of step 0"),
        (lambda f: f.__delitem__("data"), "no known layout"),
    ],
)
def test_files_of_robosuite_that_cannot_be_are_refused(tmp_path: Path, change: Any, words: str) -> None:
    path = changed(robomimic(tmp_path), change)
    with pytest.raises(PcdataError, match=words):
        open_source(path).load("demo_0_000000")


def _replace(file: Any, name: str, values: np.ndarray) -> None:
    del file[name]
    file[name] = values


def _link(file: Any, name: str) -> None:
    del file[name]
    file[name] = h5py.ExternalLink("/etc/passwd", "/x")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<mujoco>", "is no XML"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><mujoco/>', "no document type"),
        ('<mujoco><statistic extent="big"/></mujoco>', "extent must be numbers"),
        ('<mujoco><worldbody><camera name="a" pos="1 2"/></worldbody></mujoco>', "pos must be 3 finite numbers"),
        ('<mujoco><worldbody><camera name="a" quat="0 0 0 0"/></worldbody></mujoco>', "quaternion is 0"),
        ("<mujoco><worldbody>" + "<body>" * 300 + "</body>" * 300 + "</worldbody></mujoco>", "more than 200 deep"),
    ],
)
def test_models_that_cannot_be_are_refused(text: str, words: str) -> None:
    with pytest.raises(CaptureError, match=words):
        read_mujoco_model("test", text)


# -- ManiSkill ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("positions", [False, True], ids=["rgb+depth", "sensor_data"])
def test_maniskill_opens_without_an_option(tmp_path: Path, positions: bool) -> None:
    source = open_source(maniskill(tmp_path, positions=positions))
    assert source.ids == [f"traj_{number}_{step:06d}" for number in (0, 1) for step in range(2)]
    frame = source.load("traj_1_000001")
    assert frame.provenance["cameras"] == ["base_camera", "hand_camera"]
    expected = torch.from_numpy((depth_mm(2) * 0.001).astype(np.float32))
    expected[0, :2] = 0  # nothing was hit, and what is beyond 16 bits
    assert torch.equal(frame.depth[0], expected)
    assert np.array_equal(frame.colors[1].numpy(), color(2))
    assert (frame.labels == 16).all()
    assert frame.camera.intrinsics[0].tolist() == CENTERED
    assert frame.world_from_camera[0].numpy() == pytest.approx(camera_pose(2), abs=1e-6)
    assert open_source(tmp_path / "trajectory.h5", camera="hand_camera").load("traj_0_000000").num_views == 1


def test_the_last_observation_is_left_out_and_counted_unless_actions_are_left_out(tmp_path: Path) -> None:
    source = open_source(maniskill(tmp_path))
    last = "the last observation of its trajectory: no action follows it"
    assert source.skipped == {"traj_0_000002": last, "traj_1_000002": last}
    signals = source.load("traj_0_000001").recorded_signals
    assert signals["action"].values.tolist() == [[7.0, 8, 9, 10, 11, 12, 13]]
    assert signals["tcp_pose"].kind == "pose xyz_quat_wxyz"
    assert set(signals) == {"qpos", "qvel", "tcp_pose", "is_grasped", "action", "reward", "success", "terminated"}
    whole = open_source(tmp_path / "trajectory.h5", signals={"action": None})
    assert (len(whole), whole.skipped) == (6, {})
    assert set(whole.load("traj_1_000002").recorded_signals) == {"qpos", "qvel", "tcp_pose", "is_grasped"}
    with pytest.raises(CaptureError, match="has 3 observations and 1 actions"):
        open_source(maniskill(tmp_path / "cut", actions=1))


def test_trajectories_are_episodes_with_what_the_json_beside_them_tells(tmp_path: Path) -> None:
    path = maniskill(tmp_path)
    first, second = open_source(path).episodes
    assert (first.id, first.length, first.times, second.first) == ("traj_0", 2, (0.0, 0.05), 2)
    assert first.attributes["success"] is True
    assert second.attributes["env_id"] == "PickCube-v1"
    path.with_suffix(".json").unlink()
    assert open_source(path).episodes[0].times == ()
    path.with_suffix(".json").write_text("[" * 10_000)
    with pytest.raises(CaptureError, match=r"trajectory\.json"):
        open_source(path)


def test_two_statements_of_one_pose_that_contradict_each_other_are_an_error(tmp_path: Path) -> None:
    path = maniskill(tmp_path, axes=np.eye(4))
    with pytest.raises(PoseError, match="extrinsic_cv and cam2world_gl state poses that differ"):
        open_source(path).load("traj_0_000000")


@pytest.mark.parametrize("make", [robomimic, maniskill])
def test_a_step_is_found_again_in_another_process_and_a_cut_file_is_an_error(make: Any, tmp_path: Path) -> None:
    path = make(tmp_path)
    source = pickle.loads(pickle.dumps(open_source(path)))
    name = source.ids[-1]
    before = source.load(name)
    assert torch.equal(before.depth, open_source(path).load(name).depth)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(CaptureError):
        source.load(name)
    path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    with pytest.raises(CaptureError, match="damaged, cut short"):
        open_source(path)


def test_ids_follow_the_numbers_and_facts_are_json(tmp_path: Path) -> None:
    for make in (robomimic, maniskill):
        frame = open_source(make(tmp_path / make.__name__)).load(open_source(make(tmp_path / "b")).ids[0])
        assert json.loads(json.dumps(frame.provenance)) == frame.provenance
