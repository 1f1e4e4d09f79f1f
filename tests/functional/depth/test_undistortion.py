"""Undistorted images against OpenCV's, and what depth must keep."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pcdata import Camera, DepthFrame, Undistort
from pcdata.functional import pixel_rays, undistort_depth, undistort_image
from pcdata.functional.depth import undistortion
from pcdata.geometry.lens_models import lens_row

SIZE = (60, 80)
K = torch.tensor([[[70.0, 0.0, 39.0], [0.0, 71.0, 30.5], [0.0, 0.0, 1.0]]], dtype=torch.float64)
LENS = torch.tensor([[0.12, -0.25, 0.0011, -0.0007, 0.09]], dtype=torch.float64)
FISHEYE = torch.tensor([lens_row("test", "fisheye", [-0.01, 0.04, -0.03, 0.006])], dtype=torch.float64)


def smooth_image() -> torch.Tensor:
    v, u = torch.meshgrid(torch.arange(60.0), torch.arange(80.0), indexing="ij")
    return torch.stack([3 * u, 4 * v, 120 + 60 * (u / 9).sin() * (v / 7).cos()], -1)[None]


@pytest.mark.parametrize("lens", [LENS, FISHEYE], ids=["opencv", "fisheye"])
def test_maps_and_images_agree_with_opencv(lens):
    cv2 = pytest.importorskip("cv2")
    k = K[0].numpy()
    make = cv2.initUndistortRectifyMap if lens is LENS else cv2.fisheye.initUndistortRectifyMap
    values = lens[0].numpy() if lens is LENS else lens[0, 1:5].numpy()
    map_u, map_v = make(k, values, np.eye(3), k, SIZE[::-1], cv2.CV_32FC1)
    found = undistortion.undistortion_map(K, lens, None, SIZE)[0].numpy()
    np.testing.assert_allclose(found, np.stack([map_u, map_v], -1), atol=1e-4)
    image, valid = undistort_image(smooth_image(), K, lens)
    expected = cv2.remap(smooth_image()[0].numpy(), map_u, map_v, cv2.INTER_LINEAR)
    inside = valid[0].numpy() & (map_u > 0) & (map_u < 79) & (map_v > 0) & (map_v < 59)
    np.testing.assert_allclose(image[0].numpy()[inside], expected[inside], atol=0.3)  # its weights are 1/32 steps
    assert inside.mean() > 0.8


def test_an_image_agrees_with_kornia():
    calibration = pytest.importorskip("kornia.geometry.calibration")
    ours, valid = undistort_image(smooth_image().double(), K, LENS)
    theirs = calibration.undistort_image(smooth_image().double().permute(0, 3, 1, 2), K, LENS).permute(0, 2, 3, 1)
    inside = valid[0, 1:-1, 1:-1]
    torch.testing.assert_close(ours[0, 1:-1, 1:-1][inside], theirs[0, 1:-1, 1:-1][inside], atol=1e-2, rtol=0)


def two_walls() -> torch.Tensor:
    depth = torch.full((1, *SIZE), 0.8)
    depth[..., 40:] = 2.0
    depth[0, 20:25, 10:15] = 0.0
    return depth


@pytest.mark.parametrize("rule", ["nearest", "surface"])
def test_depth_is_never_blended_across_an_edge_and_holes_stay(rule):
    depth, pixel_index = undistort_depth(two_walls(), K, FISHEYE, rule=rule)
    near_any = (depth[..., None] - torch.tensor([0.0, 0.8, 2.0])).abs().amin(-1)
    assert float(near_any.max()) < 1e-6
    known = pixel_index >= 0
    readings = two_walls().flatten(1).gather(1, pixel_index.flatten(1).clamp(min=0)).reshape(depth.shape)
    assert torch.equal(depth > 0, known & (readings > 0))


def test_a_slanted_plane_stays_a_plane_by_the_surface_rule():
    rays = pixel_rays(K, SIZE, FISHEYE)
    depth = (1 / (1.0 + 0.3 * rays[..., 0] - 0.2 * rays[..., 1])).float()
    straight = pixel_rays(K, SIZE)
    exact = 1 / (1.0 + 0.3 * straight[..., 0] - 0.2 * straight[..., 1])
    errors = {}
    for rule in ("nearest", "surface"):
        found, _ = undistort_depth(depth, K, FISHEYE, rule=rule)
        errors[rule] = float((found - exact)[:, 3:-3, 3:-3][found[:, 3:-3, 3:-3] > 0].abs().max())
    # What is left is the bend of the lens within a pixel.
    assert errors["surface"] < 5e-5 < 1e-3 < errors["nearest"]


def test_gradients_flow_to_the_image_the_depth_and_the_lens():
    image = smooth_image().double()[:, :6, :8, :1].clone().requires_grad_()
    lens = LENS.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda a, b: undistort_image(a, K, b)[0], (image, lens), atol=1e-4)
    depth = two_walls().requires_grad_()
    undistort_depth(depth, K, LENS)[0].sum().backward()
    assert float(depth.grad.sum()) > 1000


def test_maps_are_kept_by_lens_camera_and_size():
    undistortion._maps.clear()
    first = undistortion.undistortion_map(K, LENS, None, SIZE)
    assert undistortion.undistortion_map(K.clone(), LENS.clone(), None, SIZE) is first
    shifted = K.clone()
    shifted[:, 0, 2] += 1
    for k, lens, new, size in (
        (shifted, LENS, None, SIZE),
        (K, FISHEYE, None, SIZE),
        (K, LENS, shifted, SIZE),
        (K, LENS, None, (5, 5)),
    ):
        assert undistortion.undistortion_map(k, lens, new, size) is not first


def test_a_frame_without_its_lens_shows_the_same_surface():
    camera = Camera.pinhole(
        fx=70, fy=71, cx=39, cy=30.5, size=SIZE, distortion=[-0.01, 0.04, -0.03, 0.006], lens="fisheye"
    )
    frame = DepthFrame(
        depth=two_walls(),
        camera=camera,
        colors=smooth_image().clamp(0, 255).to(torch.uint8),
        labels=(two_walls() > 1).long(),
        mask=two_walls() > 0,
    )
    straight = Undistort()(frame)
    assert straight.camera.distortion is None
    assert torch.equal(straight.labels[straight.depth > 0], (straight.depth[straight.depth > 0] > 1).long())
    assert Undistort()(straight).depth is straight.depth
    wide = Undistort(zoom=0.5)(frame)
    beyond = wide.labels == -1
    assert bool(beyond.any())
    assert not bool((wide.mask | (wide.depth > 0))[beyond].any())
