"""The poses of a file go before those that captures have, around any layout."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from pcdata import Calibration, Camera, load_config, open_source, write_calibration
from pcdata.cli.main import main
from pcdata.errors import CaptureError, ConfigError, FrameError
from tests.captures import rig_capture, seven_scenes_capture

SIX = [0.4, -0.3, 0.5, -1.9, 0.1, 0.7]
POSE = np.eye(4)
POSE[:3, :3], POSE[:3, 3] = Rotation.from_euler("xyz", SIX[3:]).as_matrix(), SIX[:3]


def written(path: Path, said: Any) -> str:
    path.write_text(json.dumps(said))
    return str(path)


def pose(frame: Any, view: int = 0) -> np.ndarray:
    return frame.world_from_camera[view].numpy()


def test_a_camera_of_one_view_takes_the_pose_by_the_name_that_is_given(tmp_path: Path) -> None:
    root = seven_scenes_capture(tmp_path / "a")
    file = written(tmp_path / "poses.json", {"23404442": SIX, "23404442_quality": 0.9, "source": "cam2base"})
    source = open_source(root, posed={"file": file, "camera": 23404442})
    frame = pickle.loads(pickle.dumps(source)).load(source.ids[0])
    assert np.abs(pose(frame) - POSE).max() < 1e-12
    assert frame.frame_id == "base"
    assert frame.provenance["posed"] == {"file": "poses.json", "cameras": ["23404442"]}
    assert source.opened["posed"] == {"file": "poses.json", "camera": 23404442}
    assert file in source.inputs._first
    with pytest.raises(CaptureError, match=r"has no pose of view 0.*it has 23404442; camera=NAME"):
        open_source(root, posed={"file": file}).load(source.ids[0])


def test_cameras_that_the_file_lacks_keep_the_pose_that_they_have_in_the_same_frame(tmp_path: Path) -> None:
    root = rig_capture(tmp_path / "rig")
    before = open_source(root)
    kept = before.load(before.ids[0])
    first, second = kept.provenance["cameras"][:2]
    file = written(tmp_path / "poses.json", {first: SIX})
    found = open_source(root, posed={"file": file, "frame_id": kept.frame_id}).load(before.ids[0])
    assert np.abs(pose(found) - POSE).max() < 1e-12
    assert np.array_equal(pose(found, 1), pose(kept, 1))
    with pytest.raises(FrameError, match=f"{second} would keep a pose in '{kept.frame_id}'"):
        open_source(root, posed={"file": file, "frame_id": "elsewhere"}).load(before.ids[0])


def test_each_capture_takes_the_poses_of_its_episode(tmp_path: Path) -> None:
    root = seven_scenes_capture(tmp_path / "a")
    ids = open_source(root).ids
    told = [{"id": "one", "first": ids[0], "length": 1}, {"id": "two", "first": ids[1], "length": len(ids) - 1}]
    (root / "episodes.json").write_text(json.dumps({"episodes": told}))
    moved = [1.0, *SIX[1:]]
    file = written(tmp_path / "poses.json", {"one": {"1": SIX}, "two": {"1": moved}, "three": {"1": SIX}})
    source = open_source(root, posed={"file": file, "camera": "1"})
    assert [pose(source.load(name))[0, 3] for name in ids[:2]] == [0.4, 1.0]
    chosen = open_source(root, posed={"file": file, "camera": "1", "episode": "three"})
    assert pose(chosen.load(ids[1]))[0, 3] == 0.4
    part = written(tmp_path / "part.json", {"one": {"1": SIX}})
    beside = open_source(root, posed={"file": part, "camera": "1", "frame_id": "world"})
    assert "part.json has no poses for two: they keep theirs" in beside.unread()
    assert np.array_equal(pose(beside.load(ids[1])), pose(open_source(root).load(ids[1])))
    other = written(tmp_path / "other.json", {"four": {"1": SIX}})
    with pytest.raises(CaptureError, match=r"none of the captures' \(one, two\); say whose poses: episode='four'"):
        open_source(root, posed={"file": other, "camera": "1"})
    with pytest.raises(CaptureError, match="has no episode"):
        open_source(root, posed={"file": other, "camera": "1", "episode": "five"})


def test_a_calibration_file_gives_poses_to_any_layout_from_yaml_and_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = seven_scenes_capture(tmp_path / "a")
    camera = Camera.pinhole(fx=500, fy=500, cx=63.5, cy=47.5, size=(96, 128))
    cell = Calibration(cameras={"left": camera}, transforms={"table_from_left": torch.from_numpy(POSE)})
    write_calibration(tmp_path / "cell.yaml", cell)
    text = "source: {path: a, posed: {file: cell.yaml, frame_id: table, camera: left}}\ndepth: [Deproject]\n"
    (tmp_path / "config.yaml").write_text(text)
    source = load_config(tmp_path / "config.yaml").source.open()
    assert np.abs(pose(source.load(source.ids[0])) - POSE).max() < 1e-12
    words = [
        "--posed",
        str(tmp_path / "cell.yaml"),
        "--option",
        "posed.frame_id=table",
        "--option",
        "posed.camera=left",
    ]
    assert main(["inspect", str(root), *words]) == 0
    assert "'table'" in capsys.readouterr().out
    with pytest.raises(CaptureError, match="leads from none of its cameras to 'base'"):
        open_source(root, posed={"file": str(tmp_path / "cell.yaml"), "camera": "left"})
    with pytest.raises(ConfigError, match="no such file of poses"):
        open_source(root, posed={"file": str(tmp_path / "none.json")})
