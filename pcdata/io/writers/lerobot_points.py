"""The point cloud of a capture in columns of one length: what ``observation.pointcloud`` of a LeRobot dataset holds."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from pcdata.errors import ConfigError
from pcdata.functional.depth.deproject import deproject_images
from pcdata.functional.rows import transform_points
from pcdata.io.sources.lerobot_clouds import RGB, VALID, XYZ
from pcdata.structures import DepthFrame


def point_features(first: DepthFrame, count: int) -> dict[str, dict[str, Any]]:
    """Return the features of clouds of ``count`` rows.

    Raises:
        ConfigError: nothing says how the views lie to each other.
    """
    if first.num_views > 1 and first.world_from_camera is None:
        raise ConfigError(
            f"lerobot: points: {first.num_views} views without poses are no cloud; give the captures their poses, or "
            "leave points out"
        )
    features = {XYZ: {"dtype": "float32", "shape": [count, 3], "names": ["point", "xyz"]}}
    if first.colors is not None:
        features[RGB] = {"dtype": "uint8", "shape": [count, 3], "names": ["point", "rgb"]}
    return {**features, VALID: {"dtype": "bool", "shape": [count], "names": None}}


def point_columns(frame: DepthFrame, count: int) -> dict[str, Any]:
    """Return the points of all views in the frame that their poses lead to, else in the camera's.

    Of more than ``count`` readings so many are taken, evenly through the rows of pixels; fewer are followed by zeros,
    which ``valid_mask`` tells.
    """
    made = deproject_images(frame.depth, frame.camera.intrinsics, frame.camera.distortion, None, {})
    points = made.points
    if frame.world_from_camera is not None:
        points = transform_points(points, made.ptr, frame.world_from_camera)
    number = len(points)
    kept = torch.arange(min(number, count), dtype=torch.int64, device="cpu")
    keep = kept if number <= count else kept * number // count
    xyz, valid = np.zeros((count, 3), np.float32), np.zeros(count, bool)
    xyz[: len(keep)], valid[: len(keep)] = points[keep].numpy(), True
    columns: dict[str, Any] = {XYZ: xyz, VALID: valid}
    if frame.colors is not None:
        rgb = np.zeros((count, 3), np.uint8)
        rgb[: len(keep)] = frame.colors.reshape(-1, 3)[made.source_index[keep]].numpy()
        columns[RGB] = rgb
    return columns
