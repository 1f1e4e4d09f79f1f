"""Finding and checking a calibration: depth quality on a plane, intrinsics from boards, camera to robot."""

from pcdata.calibration.board_images import read_board_images
from pcdata.calibration.board_pose import locate_board
from pcdata.calibration.boards import Board, BoardView, Charuco, Chessboard, Tag, parse_board
from pcdata.calibration.hand_eye import calibrate_hand_eye
from pcdata.calibration.intrinsics import calibrate_intrinsics, find_board
from pcdata.calibration.limits import CalibrationLimits
from pcdata.calibration.plane_check import PlaneResult, check_plane
from pcdata.calibration.refine import Refinement, refine_extrinsics
from pcdata.calibration.robot_poses import RobotPoses, read_robot_poses
from pcdata.structures import Calibration, Evidence

__all__ = [
    "Board",
    "BoardView",
    "Calibration",
    "CalibrationLimits",
    "Charuco",
    "Chessboard",
    "Evidence",
    "PlaneResult",
    "Refinement",
    "RobotPoses",
    "Tag",
    "calibrate_hand_eye",
    "calibrate_intrinsics",
    "check_plane",
    "find_board",
    "locate_board",
    "parse_board",
    "read_board_images",
    "read_robot_poses",
    "refine_extrinsics",
]
