"""Clouds on depth images: windows of pixels and the tree behind them give what a search of all points gives."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from pcdata import functional as F
from pcdata.contracts.dispatch import OPERATIONS
from pcdata.errors import ConfigError
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.rows import transform_points
from pcdata.kernels.cuda.windows import organized
from pcdata.rng import seeded
from tests.kernels.cuda import harness
from tests.kernels.cuda.inner_calls import cameras, depth_images

pytestmark = pytest.mark.skipif(harness.unavailable() is not None, reason=str(harness.unavailable()))
harness.register()

Cloud = tuple[Tensor, Tensor, ImageGrid]


def deprojected(shape: tuple[int, int, int], holes: float = 0.2, seed: int = 0) -> Cloud:
    depth, intrinsics = depth_images(shape, seed=seed, holes=holes), cameras(shape)
    points, ptr, pixel = F.deproject_depth(depth, intrinsics)
    return points, ptr, ImageGrid(pixel, shape[1:], intrinsics)


def moved(cloud: Cloud) -> Cloud:
    points, ptr, grid = cloud
    turn, clouds = 0.7, len(ptr) - 1
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:2, :2] = torch.tensor([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    matrix[:3, 3] = torch.tensor([0.3, -1.2, 0.5])
    there = matrix.repeat(clouds, 1, 1)
    back = torch.linalg.inv(there)
    return transform_points(points, ptr, there), ptr, ImageGrid(grid.pixel_index, grid.size, grid.intrinsics, back)


def jittered(cloud: Cloud) -> Cloud:
    """A grid that no longer fits, and points behind the camera."""
    points, ptr, grid = cloud
    points = points + 0.2 * torch.randn(points.shape, generator=seeded(3))
    points[::40, 2] *= -1
    return points, ptr, grid


def in_one_place(cloud: Cloud) -> Cloud:
    points, ptr, grid = cloud
    return points[:1].expand(len(points), 3).contiguous(), ptr, grid


CLOUDS = {
    "dense": lambda: deprojected((2, 9, 33), holes=0.0),
    "holes": lambda: deprojected((2, 9, 33), holes=0.4),
    "sparse": lambda: deprojected((1, 20, 20), holes=0.7),
    "one line": lambda: deprojected((2, 1, 60)),
    "one column": lambda: deprojected((1, 60, 1)),
    "moved": lambda: moved(deprojected((2, 9, 33))),
    "jittered": lambda: jittered(deprojected((2, 14, 18))),
    "in one place": lambda: in_one_place(deprojected((1, 9, 9))),
    "few": lambda: deprojected((3, 2, 2), holes=0.5, seed=4),
}


def agree(function, cloud: Cloud, **options) -> None:
    points, ptr, grid = cloud
    found = function(points, ptr, grid=grid, backend=harness.BACKEND, **options)
    expected = function(points, ptr, backend="torch", **options)
    pairs = zip(found, expected, strict=True) if isinstance(found, tuple) else [(found, expected)]
    for one, other in pairs:
        if one.is_floating_point() and function is F.estimate_normals:
            torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6)
        else:
            assert torch.equal(one, other)


@pytest.mark.parametrize("name", CLOUDS)
def test_windows_find_what_a_search_of_all_points_finds(name, ordered):
    cloud = CLOUDS[name]()
    for k in (1, 12, 30):
        agree(F.knn, cloud, k=k)
    agree(F.ball_query, cloud, radius=0.05, max_neighbors=8)
    for number in (2, 40):
        agree(F.statistical_outlier_mask, cloud, num_neighbors=number)
        agree(F.estimate_normals, cloud, max_neighbors=number, radius=None if number == 2 else 0.06)
    for least, radius in ((1, 0.01), (10, 0.04), (8, 5.0), (10_000, 0.02)):
        agree(F.radius_outlier_mask, cloud, min_neighbors=least, radius=radius)
    assert sum("window" in one for one in ordered.started) == 12


def test_most_points_of_a_surface_need_no_tree():
    shape = (1, 40, 50)
    depth = 1 + 0.001 * torch.rand(shape, generator=seeded(0))
    points, ptr, pixel = F.deproject_depth(depth, cameras(shape))
    grid = ImageGrid(pixel, shape[1:], cameras(shape))
    launcher = harness.use(0)
    cloud = organized(launcher, points, ptr, grid)
    mean = torch.empty(len(points), dtype=torch.float64)
    launcher.launch("pc_window_mean_distances_32", len(points), *cloud.windows, 20, math.inf, mean)
    assert int(cloud.num_rest) == 0


def test_an_image_with_few_points_is_left_to_the_tree():
    launcher = harness.use(0)
    points, ptr, grid = deprojected((1, 30, 30), holes=0.95)
    F.knn(points, ptr, k=4, grid=grid, backend=harness.BACKEND)
    assert not any("window" in one for one in launcher.started)


def test_points_too_far_apart_for_the_radius_are_refused():
    points, ptr, grid = deprojected((1, 8, 9))
    points[3] = 1e9
    for backend in ("torch", harness.BACKEND):
        with pytest.raises(ConfigError, match="radius_outlier_mask"):
            F.radius_outlier_mask(points, ptr, radius=1e-4, min_neighbors=2, grid=grid, backend=backend)


def test_room_behind_the_rows_changes_nothing(ordered):
    points, ptr, grid = deprojected((2, 9, 33))
    roomy = torch.cat([points, torch.full((50, 3), -3e5)])
    pixels = torch.cat([grid.pixel_index, grid.pixel_index[:50]])
    behind = ImageGrid(pixels, grid.size, grid.intrinsics)
    calls = {
        "statistical_outlier_mask": {"num_neighbors": 6, "std_ratio": 1.0},
        "radius_outlier_mask": {"min_neighbors": 3, "radius": 0.02},
        "estimate_normals": {"radius": 0.05, "max_neighbors": 9},
    }
    for name, options in calls.items():
        body = OPERATIONS[name].kernels["cuda"]
        found = body(points=roomy, ptr=ptr, grid=behind, **options)
        assert torch.equal(found[: len(points)], body(points=points, ptr=ptr, grid=grid, **options))
        assert found.dtype is not torch.bool or found[len(points) :].all()
