"""Finding and checking a calibration: depth quality on a plane, intrinsics from boards, camera to robot."""

from pcdata.calibration.boards import Board, BoardView, Charuco, Chessboard, parse_board
from pcdata.calibration.findings import Finding
from pcdata.calibration.intrinsics import IntrinsicsLimits, IntrinsicsResult, calibrate_intrinsics, find_board
from pcdata.calibration.plane_check import PlaneCheck, PlaneLimits, check_plane
from pcdata.io.calibration import Calibration, Evidence

__all__ = [
    "Board",
    "BoardView",
    "Calibration",
    "Charuco",
    "Chessboard",
    "Evidence",
    "Finding",
    "IntrinsicsLimits",
    "IntrinsicsResult",
    "PlaneCheck",
    "PlaneLimits",
    "calibrate_intrinsics",
    "check_plane",
    "find_board",
    "parse_board",
]
