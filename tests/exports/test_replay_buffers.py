"""The buffers of DP3's kin, with states and actions from signals, read as their projects read them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pcdata.datasets import CloudDataset
from pcdata.errors import CaptureError, ConfigError, ContractError
from pcdata.exports import TARGETS, check_export, export_dataset
from pcdata.exports.export_record import FILE_NAME, ExportRecord
from pcdata.structures import Episode, PointCloud
from pcdata.transforms import Compose, Deproject, RandomRotation, RandomSample, ToFrame
from pcdata.verdicts import Verdict
from tests.exports.samples import Samples, cloud, frame
from tests.exports.test_zarr_v2 import read_by_the_specification

COUNTS = {"dp3": 512, "dexart": 1024, "idp3": 10_000, "maniflow": 1024, "demogen": 1024, "diffusion_policy": 512}


class Recording(Samples):
    """Clouds with signals, and which of them are an episode."""

    def __init__(self, lengths: tuple[int, ...], make: Any) -> None:
        super().__init__({f"t{step}": make(step) for step in range(sum(lengths))})
        firsts = np.cumsum((0, *lengths[:-1])).tolist()
        self.episodes = [Episode(f"e{n}", first, length) for n, (first, length) in enumerate(zip(firsts, lengths))]

    def __len__(self) -> int:
        return len(self.ids)


def step(number: int, count: int = 64, frame_id: str = "base") -> PointCloud:
    """A cloud with joints, the tip of the robot, an action that leads from it to the cloud's first point, a robot."""
    made = cloud(count, seed=number, frame_id=frame_id)
    if frame_id == "camera":
        made = replace(made, points=0.3 * made.points + torch.tensor([0.0, 0.0, 0.6]))
    tip = torch.tensor([[0.1 * number, 0.2, 0.3]])
    made = made.with_signal("joints", torch.arange(7.0)[None] + number, "invariant")
    made = made.with_signal("tip", tip, "position")
    made = made.with_signal("action", made.points[:1] - tip, "displacement")
    robot = torch.cat([made.points[:96], torch.ones(min(count, 96), 4)], dim=1)
    return made.with_signal("imagin_robot", robot[None], "position + invariant 4")


def read(folder: Path, keys: list[str]) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """ReplayBuffer.copy_from_path, with what its constructor asserts."""
    assert all((folder / name / ".zgroup").is_file() for name in (".", "data", "meta"))
    ends = read_by_the_specification(folder / "meta" / "episode_ends")
    data = {key: read_by_the_specification(folder / "data" / key) for key in keys}
    assert all(len(array) == ends[-1] for array in data.values())
    return data, ends


def sequences(ends: np.ndarray, horizon: int, before: int, after: int) -> list[np.ndarray]:
    """create_indices and sample_sequence of the samplers: places of each window, the ends repeated."""
    windows = []
    for start, end in zip((0, *ends[:-1]), ends):
        for first in range(-before, end - start - horizon + after + 1):
            windows.append(start + np.clip(np.arange(first, first + horizon), 0, end - start - 1))
    return windows


# What each data set asks for of its file: keys, and the columns of a point.
LOADERS = {
    "dp3": (["state", "action", "point_cloud", "img"], 6),  # AdroitDataset
    "dexart": (["state", "action", "point_cloud", "imagin_robot", "img"], 3),  # DexArtDataset
    "idp3": (["state", "action", "point_cloud"], 6),  # GR1DexDataset3D
    "maniflow": (["point_cloud", "state", "action"], 6),  # RoboTwinDataset
    "diffusion_policy": (["obs", "action", "state", "point_cloud"], 6),  # BlockPushLowdimDataset, PushTLowdimDataset
    "demogen": (["agent_pos", "state", "action", "point_cloud"], 3),  # RobosuitePointcloudDataset, DemoGen
}


@pytest.mark.parametrize("target", LOADERS)
def test_every_data_set_finds_its_arrays_bit_for_bit(tmp_path, target):
    count, frame = COUNTS[target], "camera" if target == "idp3" else "base"
    source = Recording((3, 2), lambda number: step(number, count, frame))
    report = export_dataset(source, target, tmp_path / "out", state="joints,tip", frame=frame)
    assert (report.written, report.left_out) == (5, {})
    keys, width = LOADERS[target]
    data, ends = read(tmp_path / "out", keys)
    assert ends.tolist() == [3, 5]
    scale = 1 if target == "maniflow" else 255
    for number, name in enumerate(source.ids):
        one = source.samples[name]
        assert np.array_equal(data["point_cloud"][number, :, :3], one.points.numpy())
        if width == 6:
            assert np.array_equal(data["point_cloud"][number, :, 3:], (one.colors * scale).numpy())
        state = np.concatenate([one.signals[key][0].numpy() for key in ("joints", "tip")])
        assert np.array_equal(data["state"][number], state)
        assert np.array_equal(data["action"][number], one.signals["action"][0].numpy())
        if target == "dexart":
            assert np.array_equal(data["imagin_robot"][number], one.signals["imagin_robot"][0].numpy())
    assert data["point_cloud"].shape == (5, count, width)
    assert {array.dtype for key, array in data.items() if key != "img"} == {np.dtype(np.float32)}
    assert ("img" in data) == (tmp_path / "out/data/img").exists()
    for same in {"agent_pos", "obs"} & data.keys():
        assert np.array_equal(data[same], data["state"])
    assert check_export(tmp_path / "out", TARGETS[target].model).verdict is Verdict.PASS


def test_further_signals_are_arrays_of_their_own_names(tmp_path):
    """PushTLowdimDataset of diffusion policy: keypoint (T, K, 2) in a row, then the first two numbers of the state."""
    source = Recording((3,), lambda number: step(number).with_signal("keypoint", torch.rand(1, 9, 2), "invariant"))
    options = {"state": "tip", "num_points": 64}
    export_dataset(source, "diffusion_policy", tmp_path / "out", arrays="keypoint, joints", **options)
    data, _ = read(tmp_path / "out", ["keypoint", "state", "joints"])
    wanted = torch.cat([one.signals["keypoint"] for one in source.samples.values()])
    assert np.array_equal(data["keypoint"], wanted.numpy())
    assert np.concatenate([data["keypoint"].reshape(3, -1), data["state"][:, :2]], axis=-1).shape == (3, 20)
    for arrays, error, message in [
        ("state", ConfigError, "'state' is an array already"),
        ("joints,joints", ConfigError, "'joints' is an array already"),
        ("a/b", ConfigError, "'a/b' becomes a file name"),
        ("keypoints", CaptureError, "did you mean 'keypoint'"),
    ]:
        with pytest.raises(error, match=message):
            export_dataset(source, "dp3", tmp_path / "no", arrays=arrays, **options)


def test_gr1_draws_4096_of_the_rows_of_idp3(tmp_path):
    """point_process.uniform_sampling_numpy: one permutation for the whole sequence, no zeros added at 10,000."""
    source = Recording((2,), lambda number: step(number, 10_000, "camera"))
    export_dataset(source, "idp3", tmp_path / "out", state="joints")
    data, ends = read(tmp_path / "out", LOADERS["idp3"][0])
    window = sequences(ends, horizon=16, before=1, after=14)[0]
    rows = data["point_cloud"][window].astype(np.float32)
    chosen = np.random.default_rng(0).permutation(rows.shape[1])[:4096]
    fed = rows[:, chosen]
    assert fed.shape == (16, 4096, 6)
    assert np.array_equal(fed[-1, :, :3], source.samples["t1"].points.numpy()[chosen])


def test_the_next_state_is_the_action_in_the_coordinates_of_the_step(tmp_path):
    """RoboTwin's process_data.py: state j and cloud j go with state j + 1, and the last of an episode with none."""
    source = Recording((3, 1, 2), step)
    report = export_dataset(source, "maniflow", tmp_path / "out", state="tip", next_state=True, num_points=64)
    last = "the last step of its episode: its action would be the state after it"
    assert report.left_out == {"t2": last, "t3": "is in no episode that can be exported", "t5": last}
    record = ExportRecord.read(tmp_path / "out")
    assert (list(record.samples), record.left_out) == (["t0", "t1", "t4"], report.left_out)
    data, ends = read(tmp_path / "out", LOADERS["maniflow"][0])
    assert ends.tolist() == [2, 3]
    assert report.written == len(data["state"])  # rows, not the samples that were looked at for them
    for row, (now, after) in enumerate([(0, 1), (1, 2), (4, 5)]):
        assert np.array_equal(data["point_cloud"][row, :, :3], source.samples[f"t{now}"].points.numpy())
        assert np.allclose(data["action"][row], source.samples[f"t{after}"].signals["tip"][0].numpy(), atol=1e-7)
    moved = [torch.eye(4, dtype=torch.float64) for _ in range(2)]
    moved[0][:3, 3] = torch.tensor([1.0, 0.0, 0.0])  # the first cloud alone is centered elsewhere
    clouds = {f"t{n}": step(n).transformed(one[None]) for n, one in enumerate(moved)}
    shifted = Recording((2,), step)
    shifted.samples = clouds
    export_dataset(shifted, "maniflow", tmp_path / "moved", state="tip", next_state=True, num_points=64)
    data, _ = read(tmp_path / "moved", LOADERS["maniflow"][0])
    assert np.allclose(data["action"][0], step(1).signals["tip"][0].numpy() + np.array([1, 0, 0]), atol=1e-6)


def test_a_next_state_in_the_frame_of_a_camera_that_moves_on_is_refused(tmp_path):
    def seen(number, moves):
        pose = torch.eye(4, dtype=torch.float64)[None].clone()
        pose[:, 0, 3] = number * moves
        cloud = replace(step(number, frame_id="camera"), frames={"base": pose})
        return cloud.with_signal("tip", torch.full((1, 3), float(number)), "position", "camera")

    source = Recording((2,), step)
    source.samples = {f"t{n}": seen(n, 1.0) for n in range(2)}
    options = {"state": "tip", "next_state": True, "num_points": 64}
    with pytest.raises(CaptureError, match="'t0': the next state 'tip' is in the frame of a camera that moves"):
        export_dataset(source, "maniflow", tmp_path / "out", **options)
    source.samples = {f"t{n}": seen(n, 0.0) for n in range(2)}
    export_dataset(source, "maniflow", tmp_path / "still", **options)


def test_actions_lead_to_the_same_points_after_random_steps_that_an_episode_shares(tmp_path):
    source = Recording((3, 2), step)
    dataset = CloudDataset(source, RandomRotation(degrees=90), seed=4)
    report = export_dataset(dataset, "dp3", tmp_path / "out", state="tip", num_points=64, copies=2)
    assert any("RandomRotation" in note for note in report.notes)
    data, ends = read(tmp_path / "out", ["state", "action", "point_cloud"])
    assert ends.tolist() == [3, 5, 8, 10]
    assert np.allclose(data["state"] + data["action"], data["point_cloud"][:, 0, :3], atol=1e-6)
    plain = np.concatenate([source.samples[name].signals["tip"].numpy() for name in source.ids])
    turns = []
    for first, last in ((0, 3), (3, 5), (5, 8), (8, 10)):  # one motion for all steps of an episode and a copy
        distance = np.linalg.norm(np.diff(data["state"][first:last], axis=0), axis=1)
        assert np.allclose(
            distance, np.linalg.norm(np.diff(plain[first % 5 : first % 5 + last - first], axis=0), axis=1)
        )
        turns.append(data["state"][first] / np.linalg.norm(data["state"][first]))
    assert not np.allclose(turns[0], turns[2])


def test_side_files_and_a_random_step_that_moves_the_clouds_are_refused(tmp_path):
    robot = {"e": {"samples": np.array(["t0"]), "state": np.zeros((1, 2)), "action": np.zeros((1, 2))}}
    dataset = CloudDataset(Recording((1,), step), RandomRotation(degrees=90))
    with pytest.raises(ConfigError, match=r"random end of the pipeline moves the clouds.*as signals.*--as-stored"):
        export_dataset(dataset, "dp3", tmp_path / "out", episodes=robot, num_points=64)
    on_the_fly = CloudDataset(
        Samples({"t0": frame()}), Compose([Deproject(), RandomSample(num_points=64), RandomRotation(degrees=90)])
    )
    with pytest.raises(ConfigError, match="random end of the pipeline moves the clouds"):
        export_dataset(on_the_fly, "dp3", tmp_path / "out", episodes=robot, num_points=64)
    still = CloudDataset(Samples({"t0": frame()}), Compose([Deproject(), RandomSample(num_points=64)]))
    export_dataset(still, "dp3", tmp_path / "still", episodes=robot, num_points=64)
    with pytest.raises(ConfigError, match="next_state is for signals"):
        export_dataset(Recording((1,), step), "dp3", tmp_path / "out", episodes=robot, next_state=True)


@pytest.mark.parametrize(
    ("change", "options", "error", "message"),
    [
        (
            lambda one: one.without_signal("action"),
            {},
            CaptureError,
            "which is not there; the signals are: joints",
        ),
        (lambda one: one, {"state": "joint"}, CaptureError, "did you mean 'joints'"),
        (lambda one: one.with_signal("task", ("pick",), "text"), {"state": "task"}, CaptureError, "is a text"),
        (lambda one: one, {"action": "imagin_robot"}, CaptureError, r"of shape \(64, 7\)"),
        (lambda one: one.with_signal("joints", torch.ones(1, 6), "invariant"), {}, ContractError, r"state is \(6,\)"),
    ],
)
def test_signals_that_make_no_row_are_refused_by_the_name_of_the_sample(tmp_path, change, options, error, message):
    source = Recording((3,), step)
    source.samples["t1"] = change(source.samples["t1"])
    with pytest.raises(error, match=message) as caught:
        export_dataset(source, "dp3", tmp_path / "out", **{"state": "joints", "num_points": 64, **options})
    assert "dp3: sample" in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_a_layout_without_colors_and_episodes_of_no_use_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="x, y and z alone; leave out colors=true"):
        export_dataset(Recording((1,), step), "dexart", tmp_path / "out", colors=True)
    with pytest.raises(CaptureError, match="all 2 samples are left out"):
        export_dataset(Recording((1, 1), step), "dp3", tmp_path / "out", state="tip", next_state=True, num_points=64)


# -- samples that do not fit ---------------------------------------------------------------------------------------


def test_all_samples_that_do_not_fit_are_told_at_once(tmp_path):
    source = Recording((3, 3, 2), step)
    for name in ("t1", "t4", "t5"):
        source.samples[name] = source.samples[name].without_signal("action")
    with pytest.raises(CaptureError, match="sample 't1'") as caught:
        export_dataset(source, "dp3", tmp_path / "out", state="joints", num_points=64)
    (note,) = [note for note in caught.value.__notes__ if "--skip-bad" in note]
    assert "2 others do not fit either: 't4', 't5': CaptureError: action is the signal 'action'" in note


def test_a_step_that_does_not_fit_takes_its_episode_along(tmp_path):
    source = Recording((3, 3, 2), step)
    source.samples["t4"] = source.samples["t4"].without_signal("action")
    source.samples["t7"] = step(7, count=63)
    report = export_dataset(source, "dp3", tmp_path / "out", state="joints", num_points=64, skip_bad=True)
    assert report.written == 3
    assert report.left_out.keys() == {"t3", "t4", "t5", "t6", "t7"}
    assert report.left_out["t4"].startswith("CaptureError: action is the signal 'action', which is not there")
    assert report.left_out["t7"].startswith("ContractError")
    assert report.left_out["t3"] == "goes with a sample that is left out"
    data, ends = read(tmp_path / "out", LOADERS["dp3"][0])
    assert (ends.tolist(), len(data["state"])) == ([3], 3)
    record = json.loads((tmp_path / "out" / FILE_NAME).read_text())
    assert record["left_out"] == report.left_out
    assert record["samples"] == ["t0", "t1", "t2"]


def test_samples_in_no_episode_are_left_out_and_counted(tmp_path):
    source = Recording((3,), step)
    source.samples["after"] = step(9)
    source.ids.append("after")
    report = export_dataset(source, "dp3", tmp_path / "out", state="joints", num_points=64)
    assert report.left_out == {"after": "is in no episode that can be exported"}


def test_signals_follow_the_cloud_into_another_frame(tmp_path):
    matrix = ((0.0, -1.0, 0.0, 0.5), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    dataset = CloudDataset(Recording((2,), step), ToFrame(frame="world", start="base", matrix=matrix))
    export_dataset(dataset, "dp3", tmp_path / "out", state="tip", num_points=64, frame="world")
    data, _ = read(tmp_path / "out", ["state", "action", "point_cloud"])
    assert np.allclose(data["state"] + data["action"], data["point_cloud"][:, 0, :3], atol=1e-6)
    assert np.allclose(data["state"][1], [0.5 - 0.2, 0.1, 0.3])


def posed_step(number: int) -> PointCloud:
    """A cloud with the pose of a gripper as a 4x4, and its width."""
    angle = 0.4 * number
    pose = torch.eye(4, dtype=torch.float64)
    pose[:2, :2] = torch.tensor([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    pose[:3, 3] = torch.tensor([0.1 * number, 0.2, 0.3])
    made = cloud(512, seed=number).with_signal("eef", pose[None], "pose matrix", "base")
    return made.with_signal("width", torch.tensor([[0.08]]), "invariant")


@pytest.mark.parametrize(
    ("poses", "rotation"),
    [
        ("", lambda c, s: [c, -s, 0, s, c, 0]),
        ("xyz_rot6d_columns", lambda c, s: [c, s, 0, -s, c, 0]),
        ("xyz_axis_angle", lambda c, s: [0, 0, np.arctan2(s, c)]),
    ],
)
def test_poses_that_are_4x4_become_position_and_rotation(poses: str, rotation: Any, tmp_path: Path) -> None:
    out = tmp_path / "dp3.zarr"
    source = Recording((12,), posed_step)
    export_dataset(source, "dp3", out, state="eef,width", next_state=True, poses=poses)
    data, _ = read(out, ["state", "action"])
    wanted = [
        [0.1 * n, 0.2, 0.3, *rotation(np.cos(0.4 * n), np.sin(0.4 * n)), 0.08] for n in range(7)
    ]  # less than half a turn
    np.testing.assert_allclose(data["state"][:7], wanted, atol=1e-6)
    np.testing.assert_allclose(data["action"][:6], wanted[1:], atol=1e-6)


def check_continued(quaternions: np.ndarray, numbers: range) -> None:
    """x y z w of posed_step by its numbers: the same rotations, and each nearest to the one before."""
    half = 0.2 * np.array(numbers)
    wanted = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=1)
    sign = np.sign((quaternions * wanted).sum(1, keepdims=True))
    np.testing.assert_allclose(sign * quaternions, wanted, atol=1e-6)
    assert np.linalg.norm(np.diff(quaternions, axis=0), axis=1).max() < 0.21  # half the angle of a step


def test_quaternions_begin_with_w_above_0_and_do_not_jump_within_an_episode(tmp_path: Path) -> None:
    """Half a turn lies after the eighth step of the first and after the tenth of the second: there w passes 0."""
    out = tmp_path / "dp3.zarr"
    source = Recording((12, 14), posed_step)
    export_dataset(source, "dp3", out, state="width,eef", action="eef", poses="xyz_quat_xyzw")
    data, _ = read(out, ["state", "action"])
    for rows in (data["state"][:, 4:], data["action"][:, 3:]):
        for steps in (range(12), range(12, 26)):
            check_continued(rows[steps.start : steps.stop], steps)
            assert rows[steps.start, 3] >= 0


def test_an_action_that_is_the_next_state_has_its_sign(tmp_path: Path) -> None:
    out = tmp_path / "dp3.zarr"
    export_dataset(Recording((12,), posed_step), "dp3", out, state="eef", next_state=True, poses="xyz_quat_xyzw")
    data, _ = read(out, ["state", "action"])
    check_continued(data["state"][:, 3:], range(11))
    assert np.array_equal(data["action"][:-1], data["state"][1:])
    check_continued(data["action"][-2:, 3:], range(10, 12))


def test_recorded_quaternions_keep_their_bits_unless_they_move_or_a_layout_is_asked_for(tmp_path: Path) -> None:
    def recorded(number: int) -> PointCloud:
        pose = posed_step(number).recorded_signals["eef"].with_poses_as("xyz_quat_xyzw").values.float()
        pose = pose * torch.tensor([1, 1, 1, *[-1 if number % 2 else 1] * 4])  # as no recorder should
        return cloud(512, seed=number).with_signal("eef", pose, "pose xyz_quat_xyzw", "base")

    def moved(number: int) -> PointCloud:
        turn = torch.eye(4, dtype=torch.float64)[None]
        angle = torch.tensor(-0.4 * number)
        turn[0, :2, :2] = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()]).reshape(2, 2)
        return recorded(number).transformed(turn)

    for name, make, poses in (("kept", recorded, ""), ("written", recorded, "xyz_quat_xyzw"), ("moved", moved, "")):
        source = Recording((12,), make)
        export_dataset(source, "dp3", tmp_path / name, state="eef", action="eef", poses=poses)
        data, _ = read(tmp_path / name, ["state"])
        if name == "kept":
            values = torch.cat([one.recorded_signals["eef"].values for one in source.samples.values()])
            assert np.array_equal(data["state"], values.numpy())
        elif name == "written":
            check_continued(data["state"][:, 3:], range(12))
        else:
            np.testing.assert_allclose(data["state"][:, 3:], [[0, 0, 0, 1]] * 12, atol=1e-6)  # moved onto each other


def test_a_wrong_layout_of_poses_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="dp3: poses: a pose is written in a row as one of"):
        export_dataset(Recording((12,), posed_step), "dp3", tmp_path / "a", state="eef", action="eef", poses="rot6d")
    assert not (tmp_path / "a").exists()


def test_a_matrix_that_nobody_calls_a_pose_is_told_how_to_become_one(tmp_path: Path) -> None:
    def raw(number: int) -> PointCloud:
        made = posed_step(number).with_signal("task", ("pick",), "text")
        return made.with_signal("raw", torch.eye(4)[None], "invariant")

    for state, advice in (("raw", "its kind is 'pose matrix'"), ("task", "is a text; choose another")):
        with pytest.raises(CaptureError, match=advice):
            export_dataset(Recording((12,), raw), "dp3", tmp_path / state, state=state, next_state=True)
