"""What a camera sees of a cloud: held to the geometry of a camera, of a sphere, and to Open3D's hulls."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull

import pcdata.functional as F
from pcdata.errors import ConfigError
from pcdata.rng import seeded
from pcdata.structures import Camera

CAMERA = Camera.pinhole(fx=60.0, fy=62.0, cx=31.0, cy=20.5, size=(48, 64))


def sphere(count: int, seed: int = 0) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=seeded(seed)), dim=1)


def flipped_corners(points: np.ndarray, eye: np.ndarray, radius: float) -> set[int]:
    """The paper's two lines."""
    rays = points - eye
    length = np.linalg.norm(rays, axis=1, keepdims=True)
    flipped = rays + 2 * (radius - length) * rays / length
    return {int(row) for row in ConvexHull(np.vstack([flipped, np.zeros(3)])).vertices if row < len(points)}


# -- in view -----------------------------------------------------------------------------------------------------------


def test_points_in_view_are_those_between_the_planes_through_the_edges_of_the_image():
    points = torch.randn(4000, 3, generator=seeded(1)) * 2
    x, y, z = points.double().unbind(1)
    left, right = (-0.5 - 31.0) / 60, (63.5 - 31.0) / 60
    upper, lower = (-0.5 - 20.5) / 62, (47.5 - 20.5) / 62
    inside = (z > 0) & (x >= left * z) & (x < right * z) & (y >= upper * z) & (y < lower * z)
    found = F.frustum_mask(points, intrinsics=CAMERA.intrinsics, size=(48, 64))
    assert torch.equal(found, inside)
    assert 100 < int(found.sum()) < 1500
    between = F.frustum_mask(points, intrinsics=CAMERA.intrinsics, size=(48, 64), near=0.5, far=2.0)
    assert torch.equal(between, inside & (points[:, 2] >= 0.5) & (points[:, 2] <= 2.0))


def test_what_is_deprojected_is_in_view_and_what_the_lens_cannot_see_is_not():
    lens = Camera.pinhole(
        fx=60.0, fy=62.0, cx=31.0, cy=20.5, size=(48, 64), lens="fisheye", distortion=[0.02, -0.01, 0.0, 0.0]
    )
    depth = 0.5 + torch.rand(1, 48, 64, generator=seeded(2))
    points, ptr, _ = F.deproject_depth(depth, lens.intrinsics, distortion=lens.distortion)
    seen = {"intrinsics": lens.intrinsics, "distortion": lens.distortion}
    assert bool(F.frustum_mask(points, ptr, size=(48, 64), **seen).all())
    part = F.frustum_mask(points, ptr, size=(24, 64), **seen).reshape(48, 64)
    assert bool(part[:24].all())
    assert not bool(part[24:].any())
    assert not bool(F.frustum_mask(-points, ptr, size=(48, 64), **seen).any())


def test_each_cloud_is_seen_by_its_own_camera():
    points = torch.randn(300, 3, generator=seeded(3)) + torch.tensor([0.0, 0.0, 2.0])
    k = torch.cat([CAMERA.intrinsics, 2 * CAMERA.intrinsics])
    k[1, 2, 2] = 1.0
    ptr = torch.tensor([0, 120, 300])
    both = F.frustum_mask(points, ptr, intrinsics=k, size=(48, 64))
    for b, (start, stop) in enumerate(((0, 120), (120, 300))):
        alone = F.frustum_mask(points[start:stop], intrinsics=k[b : b + 1], size=(48, 64))
        assert torch.equal(both[start:stop], alone)
    with pytest.raises(ConfigError, match="near must be below far"):
        F.frustum_mask(points, ptr, intrinsics=k, size=(48, 64), near=2.0, far=1.0)


# -- hidden ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("factor", [1.0, 20.0, 100.0])
def test_hidden_points_are_those_off_the_hull_of_the_flipped_cloud(factor):
    points, eye = sphere(3000) * torch.tensor([1.0, 0.6, 0.3]), torch.tensor([0.5, -2.0, 1.5])
    hidden = F.hidden_point_mask(points, viewpoint=eye, radius_factor=factor)
    rays = points.double().numpy() - eye.double().numpy()
    radius = factor * np.linalg.norm(rays, axis=1).max()
    visible = flipped_corners(points.double().numpy(), eye.double().numpy(), radius)
    assert set(torch.nonzero(~hidden).squeeze(1).tolist()) == visible


def test_of_a_sphere_the_far_side_is_hidden_and_the_near_side_is_not():
    points, eye = sphere(6000), torch.tensor([0.0, 0.0, 3.0])
    hidden = F.hidden_point_mask(points, viewpoint=eye)
    facing = points[:, 2] - 1 / 3  # > 0: before the horizon
    assert bool(hidden[facing < -0.1].all())
    assert not bool(hidden[facing > 0.1].any())


def test_a_wall_hides_what_is_behind_it():
    line = torch.linspace(-1.0, 1.0, 60)
    wall = torch.cartesian_prod(line, line, torch.tensor([2.0]))
    behind = torch.cartesian_prod(line * 0.4, line * 0.4, torch.tensor([2.5]))
    aside = behind + torch.tensor([4.0, 0.0, 0.0])
    hidden = F.hidden_point_mask(torch.cat([wall, behind, aside]), viewpoint=(0.0, 0.0, 0.0), radius_factor=300.0)
    assert not bool(hidden[: len(wall)].any())
    assert float(hidden[len(wall) : len(wall) + len(behind)].float().mean()) > 0.95
    assert float(hidden[len(wall) + len(behind) :].float().mean()) < 0.05


def test_equal_points_are_hidden_together_and_flat_or_few_ones_have_an_answer():
    points = sphere(500)
    eye = (0.0, 0.0, 3.0)
    twice = F.hidden_point_mask(torch.cat([points, points]), viewpoint=eye)
    alone = F.hidden_point_mask(points, viewpoint=eye)
    assert torch.equal(twice, torch.cat([alone, alone]))
    angle = torch.arange(0.0, 2 * math.pi, 0.05)
    ring = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], 1)  # in a plane with the eye
    hidden = F.hidden_point_mask(ring, viewpoint=(3.0, 0.0, 0.0))
    assert bool(hidden[ring[:, 0] < 0.2].all())
    assert not bool(hidden[ring[:, 0] > 0.5].any())
    row = torch.tensor([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    assert F.hidden_point_mask(row, viewpoint=(0.0, 0.0, 0.0)).tolist() == [False, True, True]
    assert F.hidden_point_mask(row, viewpoint=(1.0, 0.0, 0.0)).tolist()[0] is False
    for few in (row[:0], row[:1]):
        assert not bool(F.hidden_point_mask(few, viewpoint=(0.0, 0.0, 0.0)).any())


def test_each_cloud_is_seen_from_its_own_viewpoint_at_any_scale():
    small = 2.0**-10
    points = torch.cat([sphere(400), small * sphere(300, seed=1)])
    eyes, ptr = torch.tensor([[0.0, 0.0, 3.0], [2 * small, 0.0, 0.0]]), torch.tensor([0, 400, 700])
    both = F.hidden_point_mask(points, ptr, viewpoint=eyes)
    assert torch.equal(both[:400], F.hidden_point_mask(points[:400], viewpoint=eyes[0]))
    assert torch.equal(both[400:], F.hidden_point_mask(points[400:], viewpoint=eyes[1]))
    assert torch.equal(both[400:], F.hidden_point_mask(sphere(300, seed=1), viewpoint=(2.0, 0.0, 0.0)))
    for wrong in (0.5, 0.0, float("inf")):
        with pytest.raises(ConfigError, match="radius_factor"):
            F.hidden_point_mask(points, ptr, viewpoint=eyes, radius_factor=wrong)


@pytest.mark.open3d
def test_hidden_points_are_those_of_open3d():
    o3d = pytest.importorskip("open3d")
    points, eye = sphere(4000) * torch.tensor([1.0, 0.6, 0.3]), torch.tensor([0.5, -2.0, 1.5])
    farthest = float((points.double() - eye.double()).norm(dim=1).max())
    pcd = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.double().numpy()))
    _, visible = pcd.hidden_point_removal(eye.double().numpy(), 50.0 * farthest)
    hidden = F.hidden_point_mask(points, viewpoint=eye, radius_factor=50.0)
    assert set(torch.nonzero(~hidden).squeeze(1).tolist()) == {row for row in visible if row < len(points)}
