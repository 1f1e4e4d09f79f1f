"""Intrinsics from boards: a known camera is recovered, and what cannot determine one is refused."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pcdata.calibration import (
    CalibrationLimits,
    Charuco,
    Chessboard,
    calibrate_intrinsics,
    find_board,
    parse_board,
)
from pcdata.calibration.boards import Board, BoardView
from pcdata.errors import CalibrationError, CaptureError, ConfigError
from pcdata.functional.depth.deproject import pixel_rays, project_points
from pcdata.verdicts import Verdict
from tests.calibration.boards import CAMERA, CHARUCO, CHESSBOARD, SIZE, board_pose, corner_view, good_poses, rendered


def failed(result):
    return [finding.name for finding in result.findings if finding.verdict is Verdict.FAIL]


def views(noise: float = 0.1) -> dict[str, BoardView]:
    return {f"{n:02d}.png": corner_view(pose, noise=noise, seed=n) for n, pose in enumerate(good_poses())}


def ray_error(camera) -> float:
    """The largest angle (in pixels of the true camera) between the two cameras' rays, over the image."""
    true = pixel_rays(CAMERA.intrinsics, SIZE, CAMERA.distortion)
    found = pixel_rays(camera.intrinsics, SIZE, camera.distortion)
    return float((true - found).norm(dim=-1).max()) * 605


# -- solving -------------------------------------------------------------------------------------------------------


def test_exact_corners_give_the_exact_camera():
    result = calibrate_intrinsics(views(noise=0.0), size=SIZE, board="exact")
    # float32 corners (OpenCV's) are exact to 3e-5 pixels.
    torch.testing.assert_close(result.camera.intrinsics, CAMERA.intrinsics, atol=0.02, rtol=0)
    assert result.rms < 1e-3
    assert ray_error(result.camera) < 0.02
    assert result.verdict is Verdict.PASS


def test_the_stated_uncertainty_is_the_error_made():
    scaled = []
    for trial in range(6):
        noisy = {str(n): corner_view(p, noise=0.2, seed=100 * trial + n) for n, p in enumerate(good_poses())}
        result = calibrate_intrinsics(noisy, size=SIZE, board="noisy")
        # 0.2 px on u and on v are 0.28 px of distance; 105 unknowns take their part of 1728 coordinates.
        assert result.rms == pytest.approx(0.2 * (2 * (1 - 105 / 1728)) ** 0.5, rel=0.06)
        k, truth = result.camera.intrinsics[0], CAMERA.intrinsics[0]
        errors = [k[0, 0] - truth[0, 0], k[1, 1] - truth[1, 1], k[0, 2] - truth[0, 2], k[1, 2] - truth[1, 2]]
        scaled += [float(e) / result.uncertainty[name] for e, name in zip(errors, ("fx", "fy", "cx", "cy"))]
    assert 0.6 < np.std(scaled) < 1.5


@pytest.mark.parametrize("count", [0, 4, 5, 8])
def test_the_lens_model_has_the_coefficients_asked_for(count):
    result = calibrate_intrinsics(views(), size=SIZE, board="x", num_coefficients=count)
    distortion = result.camera.distortion
    assert (0 if distortion is None else distortion.shape[1]) == count
    assert (ray_error(result.camera) < 1.5) == (count > 0)  # without coefficients the lens is not described


def test_a_blurred_view_is_named():
    given = views(noise=0.05)
    given["07.png"] = corner_view(good_poses()[7], noise=1.0, seed=7)
    result = calibrate_intrinsics(given, size=SIZE, board="x")
    assert result.poor_views == ["07.png"]


def test_evidence_holds_what_a_reader_needs():
    result = calibrate_intrinsics(views(), size=SIZE, board=str(CHESSBOARD))
    evidence = result.evidence(date="2026-01-31")
    assert evidence.method == "cv2.calibrateCamera, chessboard:9x6:0.025"
    assert (evidence.num_observations, evidence.date) == (16, "2026-01-31")
    assert evidence.residuals["reprojection_rms_px"] == result.rms
    assert result.evidence().date is None


# -- refusing ------------------------------------------------------------------------------------------------------


def test_too_few_views_are_refused_and_the_lost_ones_named():
    few = dict(list(views().items())[:5])
    with pytest.raises(CalibrationError, match=r"5 views of the board; at least 6 .* not found in dark\.png"):
        calibrate_intrinsics(few, size=SIZE, board="x", unseen=("dark.png",))


def test_boards_that_are_all_parallel_are_refused():
    asides = [(20.0 * n - 80, 10.0 * n - 40) for n in range(10)]
    flat = {
        str(n): corner_view(board_pose(0, 0, 0.3 + 0.03 * n, aside=asides[n]), noise=0.1, seed=n) for n in range(10)
    }
    with pytest.raises(CalibrationError, match=r"parallel to within .* tilt the board by 30 to 45 degrees, to all"):
        calibrate_intrinsics(flat, size=SIZE, board="x")


def test_boards_that_are_far_away_leave_the_focal_length_open_and_are_refused():
    far = {str(n): corner_view(board_pose(16 * (n % 2), 0, 4.0), noise=0.3, seed=n) for n in range(6)}
    with pytest.raises(CalibrationError, match=r"focal length is uncertain|parallel|no possible camera|not finite"):
        calibrate_intrinsics(far, size=SIZE, board="x")


def test_corners_in_one_part_of_the_image_fail_the_coverage_limit():
    left = {k: v for k, v in views().items() if v.pixels[:, 0].max() < 400}
    result = calibrate_intrinsics(left, size=SIZE, board="x", limits=CalibrationLimits(max_focal_uncertainty=1))
    assert failed(result) == ["image covered by corners"]
    assert result.coverage < 0.6


def test_a_lens_model_that_opencv_does_not_have_is_refused():
    with pytest.raises(ConfigError, match="must be 0, 4, 5 or 8, got 3"):
        calibrate_intrinsics(views(), size=SIZE, board="x", num_coefficients=3)


# -- finding boards ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO], ids=str)
def test_a_camera_is_recovered_from_rendered_boards(board: Board):
    images = {str(n): rendered(pose, board) for n, pose in enumerate(good_poses()[:10])}
    found, size = find_board(images, board)
    assert size == SIZE
    assert len(found) == 10
    result = calibrate_intrinsics(found, size=size, board=str(board), num_coefficients=4)
    assert result.rms < 0.25
    k, truth = result.camera.intrinsics[0], CAMERA.intrinsics[0]
    # Within 0.3 percent of the focal lengths and 2 pixels of the principal point, from ten images.
    assert abs(k[0, 0] / truth[0, 0] - 1) < 0.003
    assert abs(k[1, 1] / truth[1, 1] - 1) < 0.003
    assert (k[:2, 2] - truth[:2, 2]).abs().max() < 2


@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO], ids=str)
def test_corners_are_found_where_they_are_projected(board: Board):
    pose = board_pose(25, -20, 0.45, aside=(30.0, -20.0))
    found = board.find(rendered(pose, board))
    assert found is not None
    points = torch.from_numpy(found.board_points)
    camera_points = points @ pose[:3, :3].mT + pose[:3, 3]
    exact, _ = project_points(camera_points, intrinsics=CAMERA.intrinsics, distortion=CAMERA.distortion)
    errors = np.linalg.norm(exact.numpy() - found.pixels, axis=1)
    if isinstance(board, Chessboard) and errors.max() > 5:  # turned by half a turn it is the same board
        errors = np.linalg.norm(exact.numpy()[::-1] - found.pixels, axis=1)
    assert np.sqrt((errors**2).mean()) < 0.3
    assert np.abs((exact.numpy() - found.pixels).mean(axis=0)).max() < 0.15  # no shift by half a pixel


def test_a_board_described_by_its_squares_is_recognized_as_that_mistake():
    images = {"a": rendered(board_pose(10, 10, 0.45), CHESSBOARD)}
    with pytest.raises(CalibrationError, match=r"count inner corners, not squares: chessboard:9x6:0.025"):
        find_board(images, Chessboard(10, 7, 0.025))


def test_a_legacy_charuco_board_is_recognized_as_one():
    legacy = Charuco(8, 6, 0.03, 0.022, "5X5_100", legacy=True)  # the patterns differ for even numbers of rows
    images = {"a": rendered(board_pose(10, 10, 0.45), legacy)}
    with pytest.raises(CalibrationError, match=r"legacy pattern: charuco:8x6:0.03:0.022:5X5_100:legacy"):
        find_board(images, Charuco(8, 6, 0.03, 0.022, "5X5_100"))


def test_images_without_a_board_or_of_two_sizes_are_refused():
    gray = np.full(SIZE, 128, np.uint8)
    with pytest.raises(CalibrationError, match="is in none of the 2 images; is it in focus"):
        find_board({"a": gray, "b": gray}, CHARUCO)
    with pytest.raises(CaptureError, match="images of one size"):
        find_board({"a": gray, "b": gray[:100]}, CHARUCO)
    with pytest.raises(CaptureError, match="got no image"):
        find_board({}, CHARUCO)


@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO, Charuco(8, 6, 0.03, 0.022, "4X4_50", legacy=True)], ids=str)
def test_a_board_is_written_as_it_is_read(board: Board):
    assert parse_board(str(board)) == board


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("chess:9x6:0.025", "a board is chessboard:COLSxROWS:SQUARE, charuco:.* or tag:"),
        ("chessboard:9:0.025", "a board is"),
        ("chessboard:9x6", "a board is"),
        ("charuco:7x5:0.04:0.03", "a board is"),
        ("chessboard:9x6:25mm", "'25mm' in .* is no length in metres"),
        ("chessboard:9x6:25", r"up to 1 m \(metres, not millimetres\)"),
        ("chessboard:2x6:0.025", "at least 3x3 inner corners"),
        ("charuco:7x5:0.03:0.04:5X5_100", "markers smaller than squares"),
    ],
)
def test_what_is_no_board_is_refused(text: str, message: str):
    with pytest.raises(ConfigError, match=message):
        parse_board(text)


def test_an_unknown_dictionary_is_refused_with_the_nearest():
    with pytest.raises(ConfigError, match="no dictionary '5X5_10'; did you mean '5X5_100'"):
        Charuco(7, 5, 0.04, 0.03, "5X5_10").find(np.zeros((48, 64), np.uint8))
