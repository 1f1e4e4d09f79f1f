"""Rendered points, triangles and ranges against brute force over pixels, and the laws of their ways back."""

from __future__ import annotations

import math

import pytest
import torch

from pcdata.errors import ConfigError
from pcdata.functional import (
    deproject_depth,
    deproject_ranges,
    depth_normals,
    pixel_rays,
    project_points,
    render_points,
    render_ranges,
    render_triangles,
)
from pcdata.geometry.lens_models import lens_row
from pcdata.rng import seeded

SIZE = (24, 32)
K = torch.tensor([[[30.0, 0.0, 15.5], [0.0, 31.0, 11.5], [0.0, 0.0, 1.0]]], dtype=torch.float64)
FISHEYE = torch.tensor([lens_row("test", "fisheye", [-0.01, 0.04, -0.03, 0.006])], dtype=torch.float64)


def cloud(count: int, seed: int = 0) -> torch.Tensor:
    drawn = torch.rand(count, 3, generator=seeded(seed))
    return drawn * torch.tensor([1.4, 1.0, 1.0]) + torch.tensor([-0.7, -0.5, 0.6])


@pytest.mark.parametrize("lens", [None, FISHEYE], ids=["pinhole", "fisheye"])
@pytest.mark.parametrize("point_size", [0.0, 0.1])
def test_points_are_those_that_brute_force_finds_in_front(lens, point_size):
    points = cloud(60)
    found = render_points(points, intrinsics=K, distortion=lens, size=SIZE, point_size=point_size)
    pixels, z = project_points(points, intrinsics=K, distortion=lens)
    for v in range(SIZE[0]):
        for u in range(SIZE[1]):
            half = (point_size * torch.stack([30 / z, 31 / z], 1).double()).clamp(min=1.0) / 2
            center = torch.tensor([float(u), float(v)], dtype=torch.float64)
            covers = ((pixels - half <= center) & (center < pixels + half)).all(1).nonzero().squeeze(1)
            nearest = int(covers[z[covers].argmin()]) if len(covers) else 60
            assert int(found.point_index[0, v, u]) == nearest
            assert float(found.depth[0, v, u]) == (float(z[nearest]) if len(covers) else 0.0)


def test_the_points_of_a_depth_image_render_to_that_image():
    depth = 0.5 + torch.rand(2, *SIZE, generator=seeded(1))
    depth[torch.rand(2, *SIZE, generator=seeded(2)) < 0.3] = 0
    k = K.repeat(2, 1, 1)
    lens = FISHEYE.repeat(2, 1)
    points, ptr, _ = deproject_depth(depth, k, distortion=lens)
    found = render_points(points, ptr, intrinsics=k, distortion=lens, size=SIZE)
    assert torch.equal(found.depth, depth)
    assert torch.equal(found.point_index[depth > 0], torch.arange(len(points)))


@pytest.mark.parametrize("lens", [None, FISHEYE], ids=["pinhole", "fisheye"])
def test_triangles_are_met_where_brute_force_meets_them(lens):
    triangles = cloud(24, seed=3).reshape(8, 3, 3)
    found = render_triangles(triangles, intrinsics=K, distortion=lens, size=SIZE)
    rays = pixel_rays(K, SIZE, lens)[0].reshape(-1, 2)
    directions = torch.cat([rays, torch.ones(len(rays), 1, dtype=torch.float64)], 1)
    corners = triangles.double()
    best = torch.full((len(rays),), math.inf, dtype=torch.float64)
    for corner in corners:  # the ray as a mix of the three corners, solved
        mix = torch.linalg.solve(corner.T, directions.T).T
        depth = torch.where((mix >= 0).all(1), 1 / mix.sum(1), math.inf)
        best = torch.minimum(best, depth)
    expected = torch.where(best.isinf(), 0.0, best).float().reshape(SIZE)
    torch.testing.assert_close(found.depth[0], expected, atol=1e-6, rtol=0)
    hit = found.triangle_index[0] < 8
    assert torch.equal(hit, expected > 0)
    mixed = (corners[found.triangle_index[0][hit]] * found.weights[0][hit].double()[..., None]).sum(1)
    torch.testing.assert_close(mixed[:, 2].float(), expected[hit], atol=1e-5, rtol=0)


def test_meshes_of_a_batch_are_drawn_in_their_own_images():
    triangles = cloud(24, seed=3).reshape(8, 3, 3)
    both = render_triangles(triangles, torch.tensor([0, 3, 8]), intrinsics=K.repeat(2, 1, 1), size=SIZE)
    for view, part in enumerate((triangles[:3], triangles[3:])):
        assert torch.equal(both.depth[view], render_triangles(part, intrinsics=K, size=SIZE).depth[0])


def test_range_images_go_both_ways():
    ranges = 2 + torch.rand(2, 16, 64, generator=seeded(5)) * 30
    ranges[torch.rand(2, 16, 64, generator=seeded(6)) < 0.2] = 0
    points, ptr, pixel_index = deproject_ranges(ranges)
    back = render_ranges(points, ptr, size=(16, 64))
    torch.testing.assert_close(back.depth, ranges, atol=1e-5, rtol=0)
    assert torch.equal(back.point_index[ranges > 0], torch.arange(len(points)))
    assert torch.equal(pixel_index[: int(ptr[1])], ranges[0].flatten().nonzero().squeeze(1))


def test_a_lidar_sees_ahead_in_the_middle_left_on_the_left_and_up_on_top():
    points = torch.tensor(
        [[5.0, 0.01, 0.0], [0.0, 5.0, 0.0], [5.0, 0.01, 0.9], [5.0, 0.01, -0.9], [2.5, 0.005, 0.0], [5.0, 0, 4]]
    )
    image = render_ranges(points, size=(3, 8), elevations=(-0.18, 0.18))
    assert image.point_index[0].tolist() == [
        [6, 6, 6, 2, 6, 6, 6, 6],
        [6, 6, 1, 4, 6, 6, 6, 6],  # the nearer of two ahead; the one far above is seen by no beam
        [6, 6, 6, 3, 6, 6, 6, 6],
    ]
    with pytest.raises(ConfigError, match="elevations must ascend"):
        render_ranges(points, size=(3, 8), elevations=(0.2, -0.2))


@pytest.mark.parametrize("lens", [None, FISHEYE], ids=["pinhole", "fisheye"])
def test_normals_of_a_plane_are_its_own_and_edges_are_no_surface(lens):
    normal = torch.tensor([0.3, -0.2, -1.0], dtype=torch.float64)
    normal /= normal.norm()
    rays = pixel_rays(K, SIZE, lens)
    plane = -0.8 / (rays[..., 0] * normal[0] + rays[..., 1] * normal[1] + normal[2])
    depth = plane.float()
    depth[:, :, 16:] += 0.5  # a second plane behind the edge
    depth[0, 5, 5] = 0
    found, curvature = depth_normals(depth, K, distortion=lens, max_jump=0.1)
    inside = torch.ones(SIZE, dtype=torch.bool)
    inside[5, 5] = False
    left = found[0, :, :16][inside[:, :16]]
    torch.testing.assert_close(left, normal.float().expand_as(left), atol=2e-3, rtol=0)
    assert float(curvature[0, :, :16].max()) < 1e-6
    assert found[0, 5, 5].tolist() == [0, 0, 0]


def test_a_sphere_curves_more_the_smaller_it_is():
    rays = pixel_rays(K, SIZE)
    for radius, least, most in ((0.2, 1e-5, 1e-2), (2.0, 1e-8, 1e-4)):
        center, squared = 1.0 + radius, 1 + rays.square().sum(-1)
        inside = center**2 - squared * (center**2 - radius**2)
        depth = torch.where(inside > 0, (center - inside.clamp(min=0).sqrt()) / squared, 0.0).float()
        curvature = depth_normals(depth, K, max_jump=0.1)[1][0, 12, 16]
        assert least < float(curvature) < most
