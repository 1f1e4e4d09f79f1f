"""Boards rendered as a known camera sees them, and their corners projected exactly."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from torch import Tensor

from pcdata.calibration.boards import BoardView, Charuco, Chessboard, GrayImage
from pcdata.functional.depth.deproject import pixel_rays, project_points
from pcdata.functional.rows import transform_points
from pcdata.geometry import rigid
from pcdata.rng import seeded
from pcdata.structures import Camera

SIZE = (480, 640)
CAMERA = Camera.pinhole(
    fx=604.0, fy=606.5, cx=316.2, cy=244.7, size=SIZE, distortion=[0.08, -0.15, 0.001, -0.0015, 0.0]
)
CHESSBOARD = Chessboard(9, 6, 0.025)
CHARUCO = Charuco(9, 7, 0.03, 0.022, "5X5_100")


def board_pose(tilt_x: float, tilt_y: float, distance: float, *, aside: tuple[float, float] = (0.0, 0.0)) -> Tensor:
    """camera_from_board (4, 4) of a board whose center is ``distance`` away; angles in degrees, ``aside`` in pixels."""
    axes = torch.eye(3, dtype=torch.float64)
    angles = torch.deg2rad(torch.tensor([tilt_x, tilt_y], dtype=torch.float64))
    rotation = rigid.rotation_about_axis(axes[0], angles[0]) @ rigid.rotation_about_axis(axes[1], angles[1])
    center = torch.tensor([aside[0] / 605 * distance, aside[1] / 605 * distance, distance], dtype=torch.float64)
    middle = torch.tensor([0.1, 0.0625, 0.0], dtype=torch.float64)  # of the 9x6 chessboard's corners
    return rigid.from_rotation_translation(rotation, center - rotation @ middle)


def good_poses() -> list[Tensor]:
    """Views as a careful person takes them: near and far, tilted about both axes, into all corners."""
    tilts = [(0, 0), (35, 0), (-35, 0), (0, 35), (0, -35), (25, 25), (-25, 25), (20, -30)]
    corners = [(-130.0, -90.0), (130.0, -90.0), (130.0, 90.0), (-130.0, 90.0)]
    return [
        board_pose(*tilts[n % 8], 0.44 + 0.02 * (n % 3), aside=corners[n % 4 if n < 8 else 3 - n % 4])
        for n in range(16)
    ]


def corner_view(pose: Tensor, *, noise: float = 0.0, seed: int = 0, camera: Camera = CAMERA) -> BoardView:
    """The chessboard's corners as the camera sees them, with normal noise in pixels on u and v."""
    board = CHESSBOARD
    row, column = np.divmod(np.arange(board.cols * board.rows), board.cols)
    points = torch.from_numpy(np.stack([column, row, 0 * row], axis=1) * board.square)
    moved = transform_points(points, torch.tensor([0, len(points)]), pose[None])
    pixels, _ = project_points(moved, intrinsics=camera.intrinsics, distortion=camera.distortion)
    pixels += noise * torch.randn(pixels.shape, dtype=torch.float64, generator=seeded(seed))
    return BoardView(points.numpy(), pixels.numpy())


def rendered(pose: Tensor, board: Chessboard | Charuco) -> GrayImage:
    """The image of the board before a gray wall, (480, 640)."""
    x, y = _on_board(pose)
    image = _chessboard(x, y, board) if isinstance(board, Chessboard) else _charuco(x, y, board)
    return image.round().clamp(0, 255).to(torch.uint8).numpy()


@cache
def _rays() -> Tensor:
    return pixel_rays(CAMERA.intrinsics, CAMERA.size, CAMERA.distortion)[0]


def _on_board(pose: Tensor) -> tuple[Tensor, Tensor]:
    """Where on the board the ray of every pixel ends: the plane z = 0 of the board."""
    rays = torch.nn.functional.pad(_rays(), (0, 1), value=1.0)
    board_from_camera = rigid.invert_rigid(pose)
    directions = rays @ board_from_camera[:3, :3].mT
    origin = board_from_camera[:3, 3]
    hit = origin - directions * (origin[2] / directions[..., 2])[..., None]
    return hit[..., 0], hit[..., 1]


def _chessboard(x: Tensor, y: Tensor, board: Chessboard) -> Tensor:
    column, row = x / board.square, y / board.square  # the first inner corner is (0, 0)
    inside = (column > -1) & (column < board.cols) & (row > -1) & (row < board.rows)
    margin = (column > -2) & (column < board.cols + 1) & (row > -2) & (row < board.rows + 1)
    pattern = 127.5 + 100 * _square_wave(column) * _square_wave(row)
    return torch.where(inside, pattern, torch.where(margin, 227.5, 120.0))


def _square_wave(phase: Tensor) -> Tensor:
    """+1 and -1 by turns, averaged over each pixel's footprint: hard edges would shift the corners."""
    width = sum(gradient.abs() for gradient in torch.gradient(phase))

    def integral(at: Tensor) -> Tensor:
        return 1 - (at % 2 - 1).abs()

    return (integral(phase + width / 2) - integral(phase - width / 2)) / width


def _charuco(x: Tensor, y: Tensor, board: Charuco) -> Tensor:
    side = 40  # pixels of the drawing per square, about as many as in the image; bilinear in between
    drawing = torch.from_numpy(board.opencv_board().generateImage((board.cols * side, board.rows * side))).double()
    span = torch.tensor([board.cols, board.rows], dtype=torch.float64) * board.square
    grid = 2 * torch.stack([x, y], dim=-1) / span - 1
    seen = torch.nn.functional.grid_sample(drawing[None, None] - 160, grid[None], align_corners=False)[0, 0]
    return seen + 160
