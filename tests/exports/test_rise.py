"""RISE, read as rise-policy/RISE reads it: dataset/realworld.py, dataset/projector.py."""

from __future__ import annotations

import json
import pickletools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from pcdata.errors import CaptureError, ConfigError
from pcdata.exports import export_dataset
from pcdata.structures import DepthFrame, Episode
from tests.exports.samples import Samples, frame

CAMERA = "750612070851"
INHAND, TOOL_FROM_INHAND = "043322070878", [[0, -1, 0, 0], [1, 0, 0, 0.077], [0, 0, 1, 0.2665], [0, 0, 0, 1]]
POSE = frame(seed=9).world_from_camera


def step(number: int, **changes: Any) -> DepthFrame:
    """A view of a camera that stands still, the tool in the robot's frame and the width of the gripper."""
    turn = Rotation.from_rotvec([0.1 * number, 0.4, -0.2]).as_quat()  # x y z w
    tcp = torch.tensor(np.concatenate([[0.1 * number, 0.2, 0.3], turn]))[None]
    made = frame(seed=number, world_from_camera=POSE, **changes)
    made = made.with_signal("tcp", tcp, "pose xyz_quat_xyzw", "table")
    return made.with_signal("gripper", torch.tensor([[0.01 * number]]), "invariant")


class Recording(Samples):
    def __init__(self, lengths: tuple[int, ...], make: Any = step, times: bool = False) -> None:
        super().__init__({f"t{number}": make(number) for number in range(sum(lengths))})
        firsts = np.cumsum((0, *lengths[:-1])).tolist()
        self.episodes = [
            Episode(f"e{n}", first, length, [0.0401 * k for k in range(length)] if times else ())
            for n, (first, length) in enumerate(zip(firsts, lengths))
        ]

    def __len__(self) -> int:
        return len(self.ids)


def matrix(pose: np.ndarray) -> np.ndarray:
    """xyz_rot_to_mat of x y z and a quaternion w x y z, in float32 as there."""
    result = np.eye(4, dtype=np.float32)
    result[:3, :3] = Rotation.from_quat(np.roll(pose[3:], -1)).as_matrix()
    result[:3, 3] = pose[:3]
    return result


def camera_from_base(calibration: Path) -> np.ndarray:
    """Projector.__init__: cam_to_base of the camera."""
    extrinsics = np.load(calibration / "extrinsics.npy", allow_pickle=True).item()
    inhand = np.array(extrinsics[INHAND]).squeeze()
    tool = matrix(np.load(calibration / "tcp.npy"))
    camera = np.array(extrinsics[CAMERA]).squeeze()
    return camera @ np.linalg.inv(inhand) @ np.array(TOOL_FROM_INHAND) @ np.linalg.inv(tool)


def windows(root: Path, split: str, num_action: int) -> list[tuple[Path, int, list[int]]]:
    """RealWorldDataset.__init__ for one observed step: folder, observed frame, frames of the actions."""
    samples = []
    for demo in sorted(path for path in (root / split).iterdir()):
        finish = json.loads((demo / "metadata.json").read_text())["finish_time"]
        names = sorted(path.name for path in (demo / f"cam_{CAMERA}" / "color").iterdir())
        ids = [int(name.split(".")[0]) for name in names if int(name.split(".")[0]) <= finish]
        for place in range(len(ids) - 1):
            actions = ids[place + 1 : place + num_action + 1]
            samples.append((demo, ids[place], actions + ids[-1:] * (num_action - len(actions))))
    return samples


@pytest.mark.parametrize("times", [False, True])
def test_the_data_set_finds_images_and_actions_in_the_cameras_frame(tmp_path, times):
    source = Recording((3, 2, 1), times=times)
    table = {"e0": {"split": "train"}, "e1": {"split": "val"}, "e2": {"split": "train"}}
    report = export_dataset(source, "rise", tmp_path / "out", table=table)
    assert report.written == 6
    assert any(f"INTRINSICS['{CAMERA}']" in note and "[[20.5, 0, 7.25, 0]" in note for note in report.notes)
    assert any("one step long" in note for note in report.notes)
    found = [*windows(tmp_path / "out", "train", 4), *windows(tmp_path / "out", "val", 4)]
    assert len(found) == 2 + 0 + 1
    order = [("t0", ["t1", "t2", "t2", "t2"]), ("t1", ["t2", "t2", "t2", "t2"]), ("t3", ["t4"] * 4)]
    for (demo, observed, acted), (name, later) in zip(found, order, strict=True):
        camera, one = demo / f"cam_{CAMERA}", source.samples[name]
        depth = np.array(Image.open(camera / f"depth/{observed}.png"), dtype=np.float32)
        assert np.array_equal((depth / np.float32(1000)).astype(np.float32), one.depth[0].numpy())
        assert np.array_equal(np.array(Image.open(camera / f"color/{observed}.png")), one.colors[0].numpy())
        stamp = (demo / "timestamp.txt").read_text().rstrip()
        projection = camera_from_base(tmp_path / "out/calib" / stamp)
        for action, name_after in zip(acted, later, strict=True):
            tcp = np.load(camera / f"tcp/{action}.npy")[:7].astype(np.float32)
            recorded = source.samples[name_after].signals["tcp"][0].numpy()
            assert np.array_equal(tcp, np.concatenate([recorded[:3], np.roll(recorded[3:], 1)]).astype(np.float32))
            wanted = np.linalg.inv(one.world_from_camera[0].numpy()) @ matrix(tcp)
            assert np.allclose(projection @ matrix(tcp), wanted, atol=1e-6)
            width = np.load(camera / f"gripper_command/{action}.npy")[0] / 1000.0 * 0.095
            assert np.isclose(width, source.samples[name_after].signals["gripper"].item(), atol=1e-8)


@pytest.mark.parametrize("kind", ["matrix", "xyz_quat_wxyz", "xyz_rot6d_rows", "xyz_rot6d_columns", "xyz_axis_angle"])
def test_every_layout_of_a_pose_becomes_the_same_pose(tmp_path, kind):
    plain = step(3)
    (x, y, z, *turn) = plain.signals["tcp"][0].tolist()
    rotation, position = Rotation.from_quat(turn), np.array([x, y, z])
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = rotation.as_matrix(), position
    rows = {
        "matrix": whole,
        "xyz_quat_wxyz": np.concatenate([position, np.roll(turn, 1)]),
        "xyz_rot6d_rows": np.concatenate([position, *rotation.as_matrix()[:2]]),
        "xyz_rot6d_columns": np.concatenate([position, *rotation.as_matrix().T[:2]]),
        "xyz_axis_angle": np.concatenate([position, rotation.as_rotvec()]),
    }
    given = plain.without_signal("tcp").with_signal("tcp", torch.tensor(rows[kind])[None], f"pose {kind}", "camera")
    export_dataset(Recording((1,), lambda _: given), "rise", tmp_path / "out")
    (path,) = (tmp_path / "out").glob("train/e0/cam_*/tcp/*.npy")
    assert np.allclose(matrix(np.load(path)), whole, atol=1e-6)
    assert np.allclose(camera_from_base(next((tmp_path / "out/calib").iterdir())), np.eye(4), atol=1e-12)


def test_matrices_of_an_episode_become_quaternions_that_do_not_jump(tmp_path):
    def made(number):
        whole = np.eye(4)
        whole[:3, :3] = Rotation.from_rotvec([0, 0.3 * number + 2, 0]).as_matrix()  # half a turn before the fourth
        return step(number).without_signal("tcp").with_signal("tcp", torch.tensor(whole)[None], "pose matrix", "table")

    export_dataset(Recording((8,), made), "rise", tmp_path / "out")
    files = sorted((tmp_path / "out").glob("train/e0/cam_*/tcp/*.npy"))
    turns = np.stack([np.load(file)[3:] for file in files])
    assert turns[0, 0] > 0 > turns[-1, 0]
    assert np.linalg.norm(np.diff(turns, axis=0), axis=1).max() < 0.16  # half the angle of a step
    several = torch.tensor([[[0.0, 0, 0, 0, 0, 0, 1]] * 2], dtype=torch.float64)
    two = step(0).without_signal("tcp").with_signal("tcp", several, "pose xyz_quat_xyzw", "table")
    with pytest.raises(CaptureError, match="tcp must be one pose"):
        export_dataset(Recording((1,), lambda _: two), "rise", tmp_path / "two")


def test_episodes_that_do_not_fit_are_refused_or_left_out(tmp_path):
    def refused(error, message, made, **options):
        source = Recording((2, 2), lambda number: made(number) if number == 1 else step(number))
        with pytest.raises(error, match=message):
            export_dataset(source, "rise", tmp_path / "out", **options)
        assert list(tmp_path.iterdir()) == []

    other = frame(seed=5).world_from_camera
    refused(CaptureError, "camera moved", lambda n: replace(step(n), world_from_camera=other))
    refused(CaptureError, "tcp is the signal 'tcp'", lambda n: step(n).without_signal("tcp"))
    refused(CaptureError, "tcp must be a 'pose LAYOUT'", step, tcp="gripper")
    refused(
        CaptureError, "one width in metres", lambda n: step(n).with_signal("gripper", torch.ones(1, 2), "invariant")
    )
    refused(CaptureError, "round_depth=true", lambda n: replace(step(n), depth=step(n).depth * 1.0005))
    refused(ConfigError, "at the tool", step, camera=INHAND)
    plain = Samples({"a": step(0)})
    with pytest.raises(ConfigError, match="which captures make an episode"):
        export_dataset(plain, "rise", tmp_path / "out")
    source = Recording((2, 2), lambda n: step(n).without_signal("tcp") if n == 1 else step(n))
    report = export_dataset(source, "rise", tmp_path / "out", skip_bad=True)
    assert report.left_out.keys() == {"t0", "t1"}
    assert [path.name for path in (tmp_path / "out/train").iterdir()] == ["e1"]


def test_a_continued_export_keeps_finished_episodes(tmp_path):
    def stop() -> DepthFrame:
        raise KeyboardInterrupt

    source = Recording((2, 2))
    source.samples["t3"] = stop
    with pytest.raises(KeyboardInterrupt):
        export_dataset(source, "rise", tmp_path / "out", resume=True)
    report = export_dataset(Recording((2, 2)), "rise", tmp_path / "out", resume=True)
    assert (report.kept, report.written) == (2, 2)


def test_the_calibration_opens_in_the_numpy_that_the_loader_was_written_for(tmp_path):
    """numpy._core came with NumPy 2: RISE's own environment cannot import it, and both know numpy.core.multiarray."""
    export_dataset(Recording((2,)), "rise", tmp_path / "out")
    (calibration,) = (tmp_path / "out/calib").iterdir()
    for name, shape in (("extrinsics", (1, 4, 4)), ("intrinsics", (3, 4))):
        written = (calibration / f"{name}.npy").read_bytes()
        header, pickled = written[:128], written[128:]
        assert header.endswith(b"\n")
        named = {text for code, text, _ in pickletools.genops(pickled) if code.name == "GLOBAL"}
        assert "numpy.core.multiarray _reconstruct" in named
        assert not any(text.startswith("numpy._core") for text in named)
        matrices = np.load(calibration / f"{name}.npy", allow_pickle=True).item()
        assert matrices[CAMERA].shape == shape
        assert matrices[CAMERA].dtype == np.float64
