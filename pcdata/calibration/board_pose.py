"""Where a board stands before a camera that is calibrated."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from pcdata.calibration.boards import BoardView
from pcdata.errors import CalibrationError
from pcdata.extras import require
from pcdata.geometry import rigid
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
    distortion = None if camera.distortion is None else camera.distortion[0].numpy()
    found, turn, place = cv2.solvePnP(view.board_points, view.pixels, k, distortion, flags=cv2.SOLVEPNP_IPPE)
    if not found:
        raise CalibrationError(
            "locate_board: no pose of the board fits its corners; is it the board that was described?"
        )
    turn, place = cv2.solvePnPRefineLM(view.board_points, view.pixels, k, distortion, turn, place)
    expected, _ = cv2.projectPoints(view.board_points, turn, place, k, distortion)
    rms = float(np.sqrt(((expected.reshape(-1, 2) - view.pixels) ** 2).sum(axis=1).mean()))
    rotation = torch.from_numpy(cv2.Rodrigues(turn)[0])
    return rigid.from_rotation_translation(rotation, torch.from_numpy(place.ravel())), rms
