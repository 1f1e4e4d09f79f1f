"""Tiny captures of every layout, made in a folder."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.io import savemat

from pcdata.errors import CaptureError
from pcdata.io import open_source, write_pcd, write_ply
from pcdata.structures import PointCloud
from tests import lerobot_datasets, published_captures, simulated_captures

HEIGHT, WIDTH = 6, 8
K: dict[str, Any] = {"width": WIDTH, "height": HEIGHT, "fx": 10.0, "fy": 11.0, "cx": 3.5, "cy": 2.5}


def image(path: Path, array: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(array).save(path)


def depth_of(seed: int, shape: tuple[int, int] = (HEIGHT, WIDTH)) -> np.ndarray:
    return np.random.default_rng(seed).integers(500, 1500, shape).astype(np.uint16)


def color_of(seed: int, shape: tuple[int, int] = (HEIGHT, WIDTH)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (*shape, 3)).astype(np.uint8)


def check_refused_after(damage: Callable[[Path], None], root: Path, message: str) -> None:
    damage(root)
    with pytest.raises(CaptureError, match=message):
        open_source(root)


def pose_text(shift: float) -> str:
    return f"0 -1 0 {shift}\n1 0 0 0\n0 0 1 0.5\n0 0 0 1\n"


def folder_capture(root: Path) -> Path:
    for i, name in enumerate(["a_2", "a_10", "a_1"]):
        image(root / "depth" / f"{name}.png", depth_of(i))
        image(root / "color" / f"{name}.png", color_of(i))
        image(root / "labels" / f"{name}.png", np.full((HEIGHT, WIDTH), i, np.uint8))
        image(root / "masks" / f"{name}.png", np.eye(HEIGHT, WIDTH, dtype=bool))
        (root / "poses").mkdir(exist_ok=True)
        (root / "poses" / f"{name}.txt").write_text(pose_text(i))
    (root / "intrinsics.json").write_text(json.dumps(K | {"metres_per_unit": 0.001, "frame_id": "base"}))
    return root


def seven_scenes_capture(root: Path, *, still: bool = False) -> Path:
    for i in (0, 20, 40):
        raw = depth_of(i)
        raw[0, :2] = 65535, 0
        image(root / f"frame-{i:06d}.depth.png", raw)
        image(root / f"frame-{i:06d}.color.png", color_of(i))
        (root / f"frame-{i:06d}.pose.txt").write_text(pose_text(0 if still else i))
    (root / "camera-intrinsics.txt").write_text("10 0 3.5\n0 11 2.5\n0 0 1\n")
    return root


def graspnet_frame(root: Path, **changes: Any) -> Path:
    label = np.zeros((HEIGHT, WIDTH), np.uint8)
    label[2, 3], label[4, 5] = 4, 7
    image(root / "depth.png", depth_of(1))
    image(root / "color.png", color_of(1))
    image(root / "label.png", label)
    image(root / "workspace_mask.png", np.eye(HEIGHT, WIDTH, dtype=bool))
    poses = np.tile(np.eye(4)[:3, :, None], (1, 1, 2))
    poses[:, 3, 1] = 0.1, 0.2, 0.3
    meta = {"intrinsic_matrix": np.array([[10, 0, 3.5], [0, 11, 2.5], [0, 0, 1]]), "factor_depth": np.array([[1000]])}
    meta |= {"cls_indexes": np.array([[4, 7]], np.uint8), "poses": poses} | changes
    savemat(root / "meta.mat", {name: value for name, value in meta.items() if value is not None})
    return root


def cloud_files(root: Path) -> Path:
    root.mkdir(parents=True)
    write_pcd(root / "b.pcd", PointCloud(points=torch.rand(5, 3), frame_id="x"))
    write_ply(root / "a.ply", PointCloud(points=torch.rand(4, 3), frame_id="x"))
    (root / "README.md").write_text("notes do not matter")
    return root


def rig_capture(root: Path) -> Path:
    for seed, camera in enumerate(["left", "right"]):
        for name in ("a_2", "a_10"):
            image(root / camera / "depth" / f"{name}.png", depth_of(seed))
            (root / camera / "poses").mkdir(exist_ok=True)
            (root / camera / "poses" / f"{name}.txt").write_text(pose_text(seed))
        (root / camera / "intrinsics.json").write_text(json.dumps(K | {"metres_per_unit": 0.001, "frame_id": "base"}))
    return root


def graspnet_capture(root: Path) -> Path:
    for name in ("frame_2", "frame_10"):
        graspnet_frame(root / name)
    return root


def bag_capture(root: Path) -> Path:
    pytest.importorskip("rosbags")
    from tests.recordings import recording, written

    root.mkdir(parents=True)
    return written(root / "a.bag", recording())


def ros_capture(root: Path) -> Path:
    pytest.importorskip("rosbags")
    from tests.ros_recordings import Types, recording, written

    make = Types(2)
    return written(root / "a.mcap", recording(make), make)


CAPTURES: dict[str, Callable[[Path], Path]] = {  # by layout; a test holds the table to the registry
    "folder": folder_capture,
    "rig": rig_capture,
    "graspnet": graspnet_capture,
    "seven_scenes": seven_scenes_capture,
    "realsense_bag": bag_capture,
    "ros": ros_capture,
    "clouds": cloud_files,
    "lerobot": lerobot_datasets.lossless,
    **published_captures.CAPTURES,
    **simulated_captures.CAPTURES,
}
OPTIONS: dict[str, dict[str, Any]] = {  # by layout: what its files cannot say
    "lerobot": {"metres_per_unit": 0.0001},
    **published_captures.OPTIONS,
}
