from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pcdata.errors import CaptureError, DTypeError, NonFiniteError, ShapeError
from pcdata.functional.depth.deproject import deproject_depth, pixel_rays, project_points, range_to_depth

LENS = torch.tensor([[0.12, -0.25, 0.0011, -0.0007, 0.09]], dtype=torch.float64)


def camera(fx: float = 50.0, fy: float = 52.0, cx: float = 15.3, cy: float = 11.8, skew: float = 0.0) -> torch.Tensor:
    return torch.tensor([[[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]], dtype=torch.float64)


def random_depth(views: int = 1, height: int = 24, width: int = 32, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    depth = 0.3 + torch.rand((views, height, width), generator=generator)
    return depth * (torch.rand(depth.shape, generator=generator) < 0.8)


def test_points_follow_the_pinhole_formula_in_row_major_order():
    depth = random_depth()
    points, ptr, pixel_index = deproject_depth(depth, camera())
    rows, columns = np.nonzero(depth[0].numpy())
    z = depth[0].numpy()[rows, columns].astype(np.float64)
    expected = np.stack([(columns - 15.3) * z / 50.0, (rows - 11.8) * z / 52.0, z], axis=1)
    np.testing.assert_allclose(points.numpy(), expected, rtol=2e-7, atol=1e-9)
    assert pixel_index.tolist() == (rows * 32 + columns).tolist()
    assert ptr.tolist() == [0, len(rows)]


def test_a_point_is_its_float32_ray_times_its_depth_to_the_bit():
    depth = random_depth()
    points, _, pixel_index = deproject_depth(depth, camera(), distortion=LENS)
    rays = pixel_rays(camera(), (24, 32), LENS).float().reshape(-1, 2)[pixel_index]
    z = depth.reshape(-1)[pixel_index]
    assert torch.equal(points, torch.stack([rays[:, 0] * z, rays[:, 1] * z, z], dim=1))


def test_the_principal_point_lies_straight_ahead():
    depth = torch.zeros(1, 3, 3)
    depth[0, 2, 1] = 0.7
    points, _, _ = deproject_depth(depth, camera(cx=1.0, cy=2.0))
    assert points.tolist() == [[0.0, 0.0, pytest.approx(0.7)]]


@pytest.mark.parametrize("lens", [None, LENS])
@pytest.mark.parametrize("skew", [0.0, 1.7])
def test_projecting_brings_every_point_back_to_its_pixel(lens, skew):
    intrinsics = camera(skew=skew)
    points, ptr, pixel_index = deproject_depth(random_depth(), intrinsics, distortion=lens)
    pixels, z = project_points(points, ptr, intrinsics=intrinsics, distortion=lens)
    expected = torch.stack([pixel_index % 32, pixel_index // 32], dim=1).double()
    torch.testing.assert_close(pixels, expected, atol=1e-5, rtol=0)
    assert torch.equal(z, points[:, 2])


def test_projection_agrees_with_opencv():
    cv2 = pytest.importorskip("cv2")
    points = torch.randn(200, 3, dtype=torch.float64) * torch.tensor([0.2, 0.2, 0.1]) + torch.tensor([0.0, 0.0, 1.0])
    expected, _ = cv2.projectPoints(points.numpy(), np.zeros(3), np.zeros(3), camera()[0].numpy(), LENS[0].numpy())
    pixels, _ = project_points(points, intrinsics=camera(), distortion=LENS)
    np.testing.assert_allclose(pixels.numpy(), expected[:, 0], atol=1e-10)


def test_rays_agree_with_opencv():
    cv2 = pytest.importorskip("cv2")
    v, u = np.mgrid[:24, :32].astype(np.float64)
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-13)
    expected = cv2.undistortPointsIter(pixels, camera()[0].numpy(), LENS[0].numpy(), None, None, stop)
    rays = pixel_rays(camera(), (24, 32), LENS)
    np.testing.assert_allclose(rays.reshape(-1, 2).numpy(), expected[:, 0], atol=1e-9)


def test_a_skewed_ray_solves_the_camera_matrix():
    rays = pixel_rays(camera(skew=2.5), (24, 32))[0]
    homogeneous = torch.cat([rays, torch.ones_like(rays[..., :1])], dim=-1) @ camera(skew=2.5)[0].T
    v, u = torch.meshgrid(torch.arange(24.0), torch.arange(32.0), indexing="ij")
    torch.testing.assert_close(homogeneous[..., 0], u.double(), atol=1e-12, rtol=0)
    torch.testing.assert_close(homogeneous[..., 1], v.double(), atol=1e-12, rtol=0)


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 3), st.integers(0, 5), st.integers(0, 5), st.integers(0, 99))
def test_a_batch_of_views_is_each_view_alone(views, height, width, seed):
    depth = random_depth(views, height, width, seed)
    intrinsics = torch.cat([camera(fx=50.0 + view) for view in range(views)])
    lenses = LENS * torch.arange(views)[:, None]
    points, ptr, pixel_index = deproject_depth(depth, intrinsics, distortion=lenses)
    alone = [
        deproject_depth(depth[v : v + 1], intrinsics[v : v + 1], distortion=lenses[v : v + 1]) for v in range(views)
    ]
    assert torch.equal(points, torch.cat([one[0] for one in alone]))
    assert torch.equal(pixel_index, torch.cat([one[2] for one in alone]))
    assert ptr.diff().tolist() == [len(one[0]) for one in alone]


def test_a_view_without_a_reading_is_an_empty_cloud():
    depth = torch.zeros(3, 4, 5)
    depth[1, 2, 2] = 1.0
    points, ptr, _ = deproject_depth(depth, camera().expand(3, 3, 3))
    assert points.shape == (1, 3)
    assert ptr.tolist() == [0, 0, 1, 1]


def test_depth_can_be_differentiated_through():
    depth = random_depth().requires_grad_()
    points, _, _ = deproject_depth(depth, camera())
    points[:, 2].sum().backward()
    assert torch.equal(depth.grad, (depth > 0).float())


def test_range_becomes_the_z_of_the_point_at_that_distance():
    depth = random_depth()
    points, _, pixel_index = deproject_depth(depth, camera(), distortion=LENS)
    ray_length = torch.zeros(24 * 32)
    ray_length[pixel_index] = points.norm(dim=1)
    converted = range_to_depth(ray_length.reshape(1, 24, 32), camera(), LENS)
    torch.testing.assert_close(converted, depth, rtol=3e-7, atol=0)
    assert torch.equal(converted == 0, depth == 0)


def test_points_without_an_image_have_no_pixel():
    barrel = torch.tensor([[-0.3, 0.0, 0.0, 0.0]], dtype=torch.float64)
    points = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.1, 0.0, 0.0], [5.0, 0.0, 1.0]])
    pixels, z = project_points(points, intrinsics=camera(), distortion=barrel)
    assert pixels.isnan().any(dim=1).tolist() == [False, True, True, True]
    assert torch.equal(z, points[:, 2])


@pytest.mark.parametrize("corner", [0.0, 1.0])
def test_a_reading_outside_the_lens_circle_is_an_error_only_if_it_is_there(corner):
    barrel = torch.tensor([[-0.3, 0.0, 0.0, 0.0]], dtype=torch.float64)
    depth = torch.zeros(1, 24, 32)
    depth[0, 12, 16] = 1.0
    depth[0, 0, 0] = corner
    wide = camera(fx=15.0, fy=15.0)
    if corner:
        with pytest.raises(CaptureError, match="cannot be inverted at 1 pixels"):
            deproject_depth(depth, wide, distortion=barrel)
    else:
        assert len(deproject_depth(depth, wide, distortion=barrel)[0]) == 1


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda k: k[0, 0, 0].neg_(), "PyRep"),
        (lambda k: k[0, 1, 1].zero_(), "fy=0"),
        (lambda k: k.copy_(k.clone().mT), "last row 0 0 1.*transposed"),
        (lambda k: k[0, 1, 0].fill_(0.1), r"K\[1,0\]"),
    ],
)
def test_impossible_intrinsics_are_refused_with_a_hint(spoil, message):
    intrinsics = camera()
    spoil(intrinsics)
    for use in (
        lambda: deproject_depth(random_depth(), intrinsics),
        lambda: project_points(torch.ones(1, 3), intrinsics=intrinsics),
        lambda: range_to_depth(random_depth(), intrinsics),
    ):
        with pytest.raises(CaptureError, match=f"intrinsics of view 0.*{message}"):
            use()


def test_bad_depth_is_refused():
    depth = random_depth()
    with pytest.raises(CaptureError, match="1 values are negative"):
        deproject_depth(
            depth.index_put((torch.tensor(0), torch.tensor(3), torch.tensor(3)), torch.tensor(-0.5)), camera()
        )
    with pytest.raises(CaptureError, match="ray_length must be metres"):
        range_to_depth(-1 - depth, camera())
    with pytest.raises(NonFiniteError):
        deproject_depth(depth / depth, camera())
    with pytest.raises(DTypeError, match="int32"):
        deproject_depth(depth.int(), camera())
    with pytest.raises(ShapeError, match="intrinsics has V=2 but depth has V=1"):
        deproject_depth(depth, camera().repeat(2, 1, 1))
    with pytest.raises(ShapeError):
        range_to_depth(depth, camera().repeat(2, 1, 1))


@pytest.mark.open3d
def test_a_real_frame_deprojects_as_open3d_does(test_data: Path):
    open3d = pytest.importorskip("open3d")
    image = pytest.importorskip("PIL.Image")
    raw = np.array(image.open(test_data / "graspnet_frame/depth.png"))
    k = pytest.importorskip("scipy.io").loadmat(test_data / "graspnet_frame/meta.mat")["intrinsic_matrix"]
    height, width = raw.shape
    theirs = open3d.geometry.PointCloud.create_from_depth_image(
        open3d.geometry.Image(raw),
        open3d.camera.PinholeCameraIntrinsic(width, height, k[0, 0], k[1, 1], k[0, 2], k[1, 2]),
        depth_scale=1000.0,
        depth_trunc=100.0,
    )
    points, _, _ = deproject_depth(torch.from_numpy(raw.astype(np.float32) / 1000)[None], torch.from_numpy(k)[None])
    np.testing.assert_allclose(points.numpy(), np.asarray(theirs.points), atol=3e-7)
