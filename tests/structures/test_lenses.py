"""What cameras with lenses other than OpenCV's polynomial see, through every door that uses a camera."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from pcdata import Camera, DepthFrame, TSDFVolume
from pcdata.calibration.board_pose import locate_board
from pcdata.calibration.boards import BoardView
from pcdata.errors import CaptureError
from pcdata.functional import deproject_depth, pixel_rays, project_points, register_depth
from pcdata.geometry.lens_models import lens_row
from pcdata.io.calibration.capture_camera import CaptureCamera, read_capture_camera, write_capture_camera
from pcdata.io.sources.joined_views import join_views

SIZE = (48, 64)
LENSES = {
    "fisheye": [-0.005, 0.04, -0.03, 0.006],
    "inverse_brown_conrady": [-0.0565, 0.0682, 0.0004, 0.0007, -0.0218],
    "f_theta": [0.5],
    "f_theta_polynomial": [0.01, -0.08, 0.02, -0.01],
    "inverse_f_theta_polynomial": [-0.01, 0.1, 0.02, 0.01],
    "opencv": [0.1, -0.05, 0.001, 0.002, 0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.02, -0.01],
}
each_model = pytest.mark.parametrize("model", LENSES)


def camera(model: str) -> Camera:
    return Camera.pinhole(fx=50, fy=51, cx=31, cy=23.5, size=SIZE, distortion=LENSES[model], lens=model)


def wall(model: str, distance: float = 0.9) -> DepthFrame:
    """A wall that faces the camera."""
    return DepthFrame(
        depth=torch.full((1, *SIZE), distance),
        camera=camera(model),
        world_from_camera=torch.eye(4, dtype=torch.float64)[None],
        frame_id="base",
    )


@each_model
def test_a_camera_comes_back_from_its_file_and_its_dictionary(model, tmp_path):
    one = camera(model)
    assert one.lenses == [(model, LENSES[model])]
    write_capture_camera(tmp_path / "camera.json", CaptureCamera(camera=one))
    assert read_capture_camera(tmp_path / "camera.json").camera.lenses == one.lenses
    assert Camera.from_dict(one.to_dict()).lenses == one.lenses
    assert f"{len(LENSES[model])} coefficients of {model}" in repr(one)


@each_model
def test_points_of_every_backend_are_those_of_the_rays(model):
    frame = wall(model)
    rays = pixel_rays(frame.camera.intrinsics, SIZE, frame.camera.distortion)[0].reshape(-1, 2)
    for backend in ("torch", "auto"):
        points, _, index = deproject_depth(
            frame.depth, frame.camera.intrinsics, distortion=frame.camera.distortion, backend=backend
        )
        torch.testing.assert_close(points[:, :2].double(), rays[index] * 0.9, atol=1e-6, rtol=0)


@each_model
def test_depth_registered_to_a_color_camera_with_this_lens_lies_where_points_project(model):
    depth = torch.zeros(1, *SIZE)
    depth[0, 10:40:6, 10:60:6] = 0.8
    color = camera(model)
    k = camera("fisheye").intrinsics
    moved = torch.eye(4, dtype=torch.float64)[None].clone()
    moved[:, 0, 3] = 0.02
    registered = register_depth(
        depth, k, color.intrinsics, moved, color_size=SIZE, color_distortion=color.distortion, max_jump=0.02
    )
    points, _, _ = deproject_depth(depth, k)
    pixels, _ = project_points(
        points.double() + moved[0, :3, 3], intrinsics=color.intrinsics, distortion=color.distortion
    )
    u, v = (pixels + 0.5).floor().long().unbind(-1)
    inside = (u >= 0) & (u < SIZE[1]) & (v >= 0) & (v < SIZE[0])
    assert int(inside.sum()) > 20
    assert bool((registered.depth[0, v[inside], u[inside]] > 0).all())


@each_model
def test_a_wall_fused_through_the_lens_is_flat_and_as_far(model):
    volume = TSDFVolume(voxel_size=0.02)
    volume.integrate(wall(model))
    points = volume.extract_points().points
    assert len(points) > 300
    assert float((points[:, 2] - 0.9).abs().max()) < 1e-3


def test_views_of_different_models_join_and_part():
    frames = [wall(model) for model in LENSES] + [
        replace(wall("fisheye"), camera=replace(camera("fisheye"), distortion=None))
    ]
    joined = join_views(frames, {})
    assert [model for model, _ in joined.camera.lenses] == [*LENSES, "opencv"]
    whole = deproject_depth(joined.depth, joined.camera.intrinsics, distortion=joined.camera.distortion)[0]
    parts = [deproject_depth(one.depth, one.camera.intrinsics, distortion=one.camera.distortion)[0] for one in frames]
    assert torch.equal(whole, torch.cat(parts))


@each_model
def test_a_board_is_found_where_it_stands(model):
    pytest.importorskip("cv2")
    board = torch.cartesian_prod(torch.arange(6.0), torch.arange(5.0)).double() * 0.04
    board = torch.cat([board, torch.zeros(len(board), 1, dtype=torch.float64)], 1)
    turn = torch.tensor([[0.96, 0.0, 0.28], [0.0, 1.0, 0.0], [-0.28, 0.0, 0.96]], dtype=torch.float64)
    place = torch.tensor([-0.1, -0.07, 0.4], dtype=torch.float64)
    one = camera(model)
    pixels, _ = project_points(board @ turn.T + place, intrinsics=one.intrinsics, distortion=one.distortion)
    view = BoardView(board_points=board.numpy(), pixels=pixels.numpy())
    pose, rms = locate_board(view, one)
    torch.testing.assert_close(pose[:3, :3], turn, atol=1e-4, rtol=0)
    torch.testing.assert_close(pose[:3, 3], place, atol=1e-4, rtol=0)
    assert rms < 1e-3


def test_lenses_that_are_none_are_refused_with_what_is_known():
    with pytest.raises(CaptureError, match="'fishy' is not known"):
        Camera.pinhole(fx=50, fy=51, cx=31, cy=23.5, size=SIZE, distortion=[0.0] * 4, lens="fishy")
    with pytest.raises(CaptureError, match="f_theta has 1 coefficients, got 0"):
        Camera.pinhole(fx=50, fy=51, cx=31, cy=23.5, size=SIZE, lens="f_theta")
    row = lens_row("test", "fisheye", LENSES["fisheye"])
    row[0] = 17.0
    with pytest.raises(CaptureError, match="begins with that of its model"):
        replace(camera("fisheye"), distortion=torch.tensor([row], dtype=torch.float64))
