"""Where a board stands before a camera that is calibrated."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.calibration.boards import BoardView
from pcdata.errors import CalibrationError
from pcdata.extras import require
from pcdata.functional.depth.deproject import project_points
from pcdata.geometry import rigid
from pcdata.geometry.lens import undistort_normalized
from pcdata.geometry.lens_models import is_plain
from pcdata.structures import Camera

_MIN_CORNERS = 4  # of a tag; what is found of a board has more


def locate_board(view: BoardView, camera: Camera) -> tuple[Tensor, float]:  # camera_from_target (4, 4), RMS in pixels
    """Return the board's pose in the camera frame and the RMS distance of its corners from where that puts them.

    A plane seen without perspective has two poses that fit alike; the better of them is taken and then refined.

    Raises:
        CalibrationError: fewer than 4 corners, or no pose fits them.

    Source: Collins & Bartoli, "Infinitesimal Plane-Based Pose Estimation", IJCV 109, 2014; cv2.solvePnPRefineLM.
    """
    cv2: Any = require("cv2")
    if len(view.pixels) < _MIN_CORNERS:
        raise CalibrationError(f"locate_board: {len(view.pixels)} corners; at least {_MIN_CORNERS} are needed")
    k = camera.intrinsics[0].numpy()
    pixels, distortion = view.pixels, None
    if camera.distortion is not None and is_plain(camera.distortion):
        distortion = camera.distortion[0].numpy()
    elif camera.distortion is not None:  # OpenCV does not know the lens
        pixels = _straightened(pixels, camera)
    found, turn, place = cv2.solvePnP(view.board_points, pixels, k, distortion, flags=cv2.SOLVEPNP_IPPE)
    if not found:
        raise CalibrationError(
            "locate_board: no pose of the board fits its corners; is it the board that was described?"
        )
    turn, place = cv2.solvePnPRefineLM(view.board_points, pixels, k, distortion, turn, place)
    rotation = torch.from_numpy(cv2.Rodrigues(turn)[0])
    pose = rigid.from_rotation_translation(rotation, torch.from_numpy(place.ravel()))
    corners = torch.from_numpy(np.asarray(view.board_points, dtype=np.float64).reshape(-1, 3))
    seen, _ = project_points(
        corners @ pose[:3, :3].T + pose[:3, 3], intrinsics=camera.intrinsics[:1], distortion=_first(camera.distortion)
    )
    return pose, float(np.sqrt(((seen.numpy() - view.pixels) ** 2).sum(axis=1).mean()))


def _straightened(pixels: NDArray[Any], camera: Camera) -> NDArray[Any]:
    """Return where a pinhole with the same matrix would see the corners (N, 2).

    Raises:
        CalibrationError: a corner lies where the lens sees nothing.
    """
    k = camera.intrinsics[0]
    at = torch.from_numpy(np.asarray(pixels, dtype=np.float64).reshape(-1, 2))
    rays = torch.linalg.solve(k, torch.cat([at, torch.ones_like(at[:, :1])], dim=1).T).T[:, :2]
    lens = _first(camera.distortion)
    assert lens is not None
    straight = undistort_normalized(rays[None], lens)[0]
    if bool(straight.isnan().any()):
        raise CalibrationError("locate_board: corners lie where the lens sees nothing; is it the lens of this camera?")
    return (straight @ k[:2, :2].T + k[:2, 2]).numpy()


def _first(lens: Tensor | None) -> Tensor | None:
    return None if lens is None else lens[:1]
