"""Intrinsics and lens distortion of a camera from images of a board."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pcdata.calibration.boards import Board, BoardView, GrayImage, Tag
from pcdata.calibration.limits import CalibrationLimits
from pcdata.errors import CalibrationError, CaptureError, ConfigError, told_apart
from pcdata.extras import require
from pcdata.structures import Camera
from pcdata.structures.calibration import Evidence
from pcdata.verdicts import Finding, Verdict, at_least, at_most, worst

COEFFICIENT_COUNTS = (0, 4, 5, 8)

# Three views determine the camera and check nothing.
_MIN_VIEWS = 6
# Boards that are all parallel leave focal length and distance inseparable, however many there are.
_MIN_TILT = math.radians(15)
# A focal length less certain than this is no calibration: 1 percent is 10 mm at 1 m.
_MAX_FOCAL_UNCERTAINTY = 0.01
_GRID = (6, 8)  # cells of the image that corners should reach: rows, columns
_POOR_VIEW = 2.0  # a view whose error is this many times the median is named


@dataclass(frozen=True, eq=False, kw_only=True)
class _IntrinsicsResult:
    """A camera and how well the images determine it. Pixels; angles in radians."""

    camera: Camera
    board: str
    rms: float  # of the reprojection errors of all corners
    view_rms: Mapping[str, float]
    uncertainty: Mapping[str, float]  # standard deviations of fx, fy, cx, cy
    coverage: float
    tilt: float  # the largest angle between two boards
    unseen: tuple[str, ...]  # images in which the board was not found
    findings: tuple[Finding, ...]

    @property
    def verdict(self) -> Verdict:
        """Whether every limit held."""
        return worst(finding.verdict for finding in self.findings)

    @property
    def poor_views(self) -> list[str]:
        """The views whose error is more than twice the median: look at them, and leave out what is blurred."""
        limit = _POOR_VIEW * float(np.median(list(self.view_rms.values())))
        return [name for name, rms in self.view_rms.items() if rms > limit]

    def evidence(self, date: str | None = None) -> Evidence:
        """Return what a calibration file keeps of this result."""
        residuals = {"reprojection_rms_px": self.rms, "coverage": self.coverage}
        residuals |= {f"{name}_standard_deviation_px": value for name, value in self.uncertainty.items()}
        return Evidence(
            method=f"cv2.calibrateCamera, {self.board}",
            num_observations=len(self.view_rms),
            residuals=residuals,
            date=date,
        )


def find_board(images: Mapping[str, GrayImage], board: Board) -> tuple[dict[str, BoardView], tuple[int, int]]:
    """Return the views in which the board was found, by image name, and the size (height, width) of all images.

    Raises:
        CaptureError: there is no image, or their sizes differ.
        ConfigError: the board is a single tag.
        CalibrationError: the board is in none of them; says so when one that is described differently is.
    """
    if isinstance(board, Tag):
        raise ConfigError(f"find_board: {board} has four corners, which tell nothing of a lens; use a ChArUco board")
    sizes = {image.shape[:2]: name for name, image in images.items()}
    if len(sizes) != 1:
        listed = ", ".join(f"{name} is {width}x{height}" for (height, width), name in sizes.items())
        raise CaptureError(f"find_board: needs images of one size, of one camera; got {listed or 'no image'}")
    views = {name: view for name, image in images.items() if (view := board.find(image)) is not None}
    if not views:
        for other, advice in board.alternatives():
            if any(other.find(image) is not None for image in images.values()):
                raise CalibrationError(f"find_board: {board} is in none of the {len(images)} images; {advice}")
        raise CalibrationError(
            f"find_board: {board} is in none of the {len(images)} images; is it in focus, evenly lit and (for a "
            "chessboard) wholly inside the image with a white margin?"
        )
    height, width = next(iter(sizes))
    return views, (height, width)


def calibrate_intrinsics(
    views: Mapping[str, BoardView],
    *,
    size: tuple[int, int],  # (height, width)
    board: str,
    num_coefficients: int = 5,
    unseen: tuple[str, ...] = (),
    limits: CalibrationLimits | None = None,
) -> _IntrinsicsResult:
    """Solve for focal lengths, principal point and distortion, and say how well they are determined.

    Args:
        views: the corners of each image; see :func:`find_board`.
        size: of the images.
        board: what the board was, for the record.
        num_coefficients: of the lens model, in OpenCV's order: 0, 4 (k1 k2 p1 p2), 5 (and k3) or 8 (and k4 k5 k6).
        unseen: names of images in which the board was not found, for the record.
        limits: None = those of :class:`CalibrationLimits`.

    Raises:
        CalibrationError: fewer than 6 views, boards that are all nearly parallel, or a focal length that stays
            uncertain by more than 1 percent.
        ConfigError: ``num_coefficients`` is none of OpenCV's.
        MissingExtraError: OpenCV is not installed.

    Source: Zhang, "A Flexible New Technique for Camera Calibration", PAMI 22(11), 2000; cv2.calibrateCamera.
    """
    if num_coefficients not in COEFFICIENT_COUNTS:
        raise ConfigError(f"calibrate_intrinsics: num_coefficients must be 0, 4, 5 or 8, got {num_coefficients}")
    if len(views) < _MIN_VIEWS:
        missed = f"; the board was not found in {', '.join(unseen)}" if unseen else ""
        raise CalibrationError(
            f"calibrate_intrinsics: {len(views)} views of the board; at least {_MIN_VIEWS} are needed, 15 to 25 are "
            f"good{missed}"
        )
    limits = limits or CalibrationLimits()
    solved = _solve(views, size, num_coefficients)
    tilt = _largest_angle(solved.rotations)
    focal = max(solved.uncertainty["fx"] / solved.matrix[0, 0], solved.uncertainty["fy"] / solved.matrix[1, 1])
    _refuse_degenerate(tilt, focal)
    coverage = _coverage(views, size)
    findings = (
        at_most(
            "reprojection RMS",
            solved.rms,
            limits.max_reprojection_rms,
            "look at the views with the largest errors and leave out what is blurred; is the board flat?",
            unit="pixels",
            shown=("px", 1.0),
        ),
        at_most(
            "focal length uncertainty",
            focal,
            limits.max_focal_uncertainty,
            "add views that are tilted by 30 to 45 degrees, to all four sides, and closer ones",
            shown=("%", 100.0),
        ),
        at_least(
            "image covered by corners",
            coverage,
            limits.min_coverage,
            "add views with the board in the edges and corners of the image",
            shown=("%", 100.0),
        ),
        Finding(
            name="largest angle between boards",
            found=f"{math.degrees(tilt):.0f} degrees",
            value=math.degrees(tilt),
            unit="degrees",
        ),
    )
    return _IntrinsicsResult(
        camera=_camera(solved, size, num_coefficients),
        board=board,
        rms=solved.rms,
        view_rms=dict(zip(views, solved.view_rms)),
        uncertainty=solved.uncertainty,
        coverage=coverage,
        tilt=tilt,
        unseen=unseen,
        findings=findings,
    )


@dataclass(frozen=True)
class _Solution:
    rms: float
    matrix: NDArray[np.float64]  # (3, 3)
    coefficients: NDArray[np.float64]  # (D,)
    rotations: NDArray[np.float64]  # (V, 3, 3) camera_from_board
    uncertainty: dict[str, float]
    view_rms: list[float]


def _solve(views: Mapping[str, BoardView], size: tuple[int, int], num_coefficients: int) -> _Solution:
    cv2: Any = require("cv2")
    flags = {
        0: cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST,
        4: cv2.CALIB_FIX_K3,
        5: 0,
        8: cv2.CALIB_RATIONAL_MODEL,
    }[num_coefficients]
    points = [view.board_points.astype(np.float32) for view in views.values()]
    pixels = [view.pixels.astype(np.float32) for view in views.values()]
    try:
        rms, matrix, coefficients, rotations, _, uncertainty, _, view_rms = cv2.calibrateCameraExtended(
            points, pixels, (size[1], size[0]), None, None, flags=flags
        )
    except cv2.error as error:
        raise CalibrationError(
            f"calibrate_intrinsics: OpenCV finds no camera that fits these views: {error}"
        ) from error
    if not (np.isfinite(matrix).all() and np.isfinite(coefficients).all()):
        raise CalibrationError("calibrate_intrinsics: the views determine no camera: OpenCV's answer is not finite")
    return _Solution(
        rms=float(rms),
        matrix=matrix,
        coefficients=coefficients.ravel(),
        rotations=np.stack([cv2.Rodrigues(vector)[0] for vector in rotations]),
        uncertainty=dict(zip(("fx", "fy", "cx", "cy"), uncertainty.ravel()[:4].tolist())),
        view_rms=view_rms.ravel().tolist(),
    )


def _refuse_degenerate(tilt: float, focal_uncertainty: float) -> None:
    if tilt < _MIN_TILT:
        tilted, needed = told_apart(math.degrees(tilt), math.degrees(_MIN_TILT))
        raise CalibrationError(
            f"calibrate_intrinsics: the boards are parallel to within {tilted} degrees, at least {needed} are "
            "needed, so focal length and distance cannot be told apart; tilt the board by 30 to 45 "
            "degrees, to all four sides"
        )
    if not focal_uncertainty <= _MAX_FOCAL_UNCERTAINTY:
        raise CalibrationError(
            f"calibrate_intrinsics: the focal length is uncertain by {100 * focal_uncertainty:.3g} percent; add views "
            "that are tilted more, about both axes, closer, and reach into the corners of the image"
        )


def _camera(solved: _Solution, size: tuple[int, int], num_coefficients: int) -> Camera:
    (fx, _, cx), (_, fy, cy), _ = solved.matrix.tolist()
    distortion = solved.coefficients[:num_coefficients].tolist() if num_coefficients else None
    try:
        return Camera.pinhole(fx=fx, fy=fy, cx=cx, cy=cy, size=size, distortion=distortion)
    except CaptureError as error:
        raise CalibrationError(f"calibrate_intrinsics: the views determine no possible camera: {error}") from error


def _largest_angle(rotations: NDArray[np.float64]) -> float:
    """Return the largest angle between the normals of two boards."""
    normals = torch.from_numpy(rotations[:, :, 2])
    cosine = (normals @ normals.T).clamp(-1, 1)
    return max(float(cosine[a, b].arccos()) for a, b in itertools.combinations(range(len(normals)), 2))


def _coverage(views: Mapping[str, BoardView], size: tuple[int, int]) -> float:
    """Return the part of the grid's cells in which a corner was seen."""
    pixels = np.concatenate([view.pixels for view in views.values()])
    # An image spans -0.5 to width - 0.5.
    cell = np.floor((pixels[:, ::-1] + 0.5) / size * _GRID).astype(int).clip(0, np.subtract(_GRID, 1))
    return len(np.unique(cell, axis=0)) / math.prod(_GRID)
