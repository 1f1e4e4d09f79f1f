"""Every operation either has the gradient that its mathematics has, or says that it has none."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import pcdata.functional.tsdf  # noqa: F401 - registers operations
from pcdata import functional as F
from pcdata.contracts.dispatch import OPERATIONS
from pcdata.functional.depth.disparity import depth_to_disparity, disparity_to_depth
from pcdata.functional.depth.resampling import decimate_depth, resize_depth
from pcdata.functional.depth.sensor_noise import err_in_disparity, surface_slope
from pcdata.functional.rows import transform_directions
from pcdata.functional.voxel_averages import voxel_mean
from pcdata.geometry import rigid
from pcdata.geometry.small_motions import motion_from_twist, twist_from_motion
from pcdata.rng import seeded

# Decisions (indices, masks, labels, planes, sizes) have no derivative; normals, registered and smoothed depth are
# documented to give none.
WITHOUT = {
    "boundary_mask",
    "box_mask",
    "core_point_mask",
    "dbscan",
    "depth_normals",
    "duplicate_mask",
    "estimate_normals",
    "f_score",
    "farthest_point_groups",
    "farthest_point_sample",
    "find_voxel_size",
    "hard_voxels",
    "iterate_closest_points",
    "flying_pixel_mask",
    "frustum_mask",
    "hidden_point_mask",
    "polygon_mask",
    "radius_outlier_mask",
    "ransac_circle",
    "ransac_cylinder",
    "ransac_line",
    "ransac_plane",
    "ransac_sphere",
    "image_clusters",
    "segment_planes",
    "supporting_plane",
    "table_surface",
    "register_depth",
    "render_points",
    "render_ranges",
    "render_triangles",
    "spatial_filter",
    "statistical_outlier_mask",
    # steps of fusion
    "find_blocks",
    "locate_views",
    "find_crossings",
    "find_triangles",
    "integrate_view",
    "pack_colors",
    "touched_blocks",
}
WITH = {
    "ball_query",
    "bilateral_filter",
    "chamfer_distance",
    "decimate_depth",
    "deproject_depth",
    "deproject_ranges",
    "fill_holes",
    "fit_paired_points",  # tests/functional/test_paired_points.py
    "hausdorff_distance",
    "interpolate_features",  # tests/functional/test_interpolation.py
    "knn",
    "median_filter",
    "neighborhood_covariance",
    "project_points",
    "radius_neighbors",
    "resize_depth",
    "undistort_depth",
    "undistort_image",  # tests/functional/depth/test_undistortion.py
    "voxel_downsample",
}
LENS = torch.tensor([[0.18, -0.02, 0.001, -0.002, 0.0]], dtype=torch.float64)
INTRINSICS = torch.tensor([[[12.0, 0.2, 7.4], [0.0, 12.5, 5.6], [0.0, 0.0, 1.0]]], dtype=torch.float64)


def image(holes: bool = True) -> Tensor:
    """(1, 12, 16) metres of one slanted surface, some pixels without a reading."""
    depth = 0.6 + 0.002 * torch.arange(192.0).reshape(1, 12, 16)
    return torch.where(torch.rand(depth.shape, generator=seeded(2)) < 0.2, 0.0, depth) if holes else depth


def slope_error(function, leaf: Tensor, step: float) -> float:
    """How far the gradient along a random direction is from the finite difference, relative to the latter."""
    generator = seeded(5)
    direction = torch.randn(leaf.shape, generator=generator, dtype=leaf.dtype) * ((leaf != 0) & (leaf != 1))
    leaf = leaf.clone().requires_grad_()
    value = function(leaf)
    weight = torch.randn(value.shape, generator=generator, dtype=torch.float64)
    (gradient,) = torch.autograd.grad((value.double() * weight).sum(), leaf)
    assert bool(torch.isfinite(gradient).all())
    ahead, behind = ((function(leaf.detach() + s * step * direction).double() * weight).sum() for s in (1, -1))
    wanted = float(ahead - behind) / (2 * step)
    assert abs(wanted) > 1e-3
    return abs(float((gradient * direction).sum()) - wanted) / abs(wanted)


def test_every_operation_is_on_one_of_the_two_lists():
    assert not WITH & WITHOUT
    assert set(OPERATIONS) == WITH | WITHOUT
    assert {name for name, operation in OPERATIONS.items() if operation.gradient} == WITH


@pytest.mark.parametrize(
    ("function", "leaf"),
    [
        (lambda d: F.deproject_depth(d, INTRINSICS, distortion=LENS)[0], image()),
        (lambda k: F.deproject_depth(image(), k, distortion=LENS)[0], INTRINSICS),
        (lambda c: F.deproject_depth(image(), INTRINSICS, distortion=c)[0], LENS),
        (lambda d: decimate_depth(d, factor=3)[0], image()),
        (lambda d: decimate_depth(d, factor=2, rule="mean")[0], image(holes=False)),
        (lambda d: resize_depth(d, size=(9, 11), max_jump=0.5)[0], image()),
        (lambda d: resize_depth(d, size=(9, 11))[0], image()),
        (lambda d: F.fill_holes(d)[0], image()),
        (lambda d: F.bilateral_filter(d, sigma_depth=0.02), image()),
        (lambda d: F.median_filter(d), image()),
        (lambda d: F.undistort_depth(d, INTRINSICS, LENS)[0], image()),
        (lambda d: F.undistort_depth(d, INTRINSICS, LENS, rule="surface")[0], image()),
        (lambda d: F.deproject_ranges(d)[0], image()),
        (lambda d: F.range_to_depth(d, INTRINSICS, LENS), image()),
        (lambda k: F.range_to_depth(image(), k, LENS), INTRINSICS),
        (lambda d: depth_to_disparity(d, INTRINSICS[:, 0, 0], 0.05), image()),
        (lambda d: disparity_to_depth(d, INTRINSICS[:, 0, 0], 0.05), image()),
    ],
    ids=[
        *("deproject depth", "deproject K", "deproject lens", "median", "mean", "resize", "nearest", "fill"),
        *("bilateral", "median filter"),
        *("undistort", "undistort by surface", "lidar"),
        *("range", "range K", "to disparity", "from disparity"),
    ],
)  # fmt: skip
def test_images_have_the_gradient_of_their_formula(function, leaf):
    assert slope_error(function, leaf, 1e-4) < 0.02


@pytest.mark.parametrize("which", ["points", "intrinsics", "distortion"])
def test_projection_has_a_gradient_beside_points_that_have_no_image(which):
    points = torch.rand(40, 3, generator=seeded(1), dtype=torch.float64) - torch.tensor([0.5, 0.5, 0.3])
    points[3] = 0.0
    given = {"points": points, "intrinsics": INTRINSICS, "distortion": LENS}
    leaf = given[which].clone().requires_grad_()
    pixels, _ = F.project_points(**{**given, which: leaf})
    seen = ~pixels.isnan()
    assert bool(seen.any())
    assert not bool(seen.all())
    pixels[seen].square().sum().backward()
    assert leaf.grad is not None
    assert bool(torch.isfinite(leaf.grad).all())
    assert float(leaf.grad.abs().max()) > 0


@pytest.mark.parametrize("size", [0.05, 0.3, 5.0])
def test_the_gradient_of_voxel_means_is_that_of_the_plain_mean(size):
    points = torch.rand(200, 3, generator=seeded(0)).requires_grad_()
    ptr = torch.tensor([0, 120, 120, 200])
    weight = torch.randn(200, 3, generator=seeded(1))
    means, _, inverse = F.voxel_downsample(points, ptr, voxel_size=size)
    assert torch.equal(means.detach(), F.voxel_downsample(points.detach(), ptr, voxel_size=size)[0])
    (found,) = torch.autograd.grad((means * weight[: len(means)]).sum(), points)
    (wanted,) = torch.autograd.grad((voxel_mean(points, inverse, len(means)) * weight[: len(means)]).sum(), points)
    assert torch.equal(found, wanted)
    assert float(found.abs().max()) > 0


def test_chamfer_distance_has_a_gradient_also_where_the_clouds_touch():
    points = torch.rand(60, 3, generator=seeded(0))
    for squared in (True, False):
        leaf = points.clone().requires_grad_()
        F.chamfer_distance(leaf, None, torch.cat([points[:30], points[30:] + 0.3]), None, squared=squared).backward()
        assert leaf.grad is not None
        assert bool(torch.isfinite(leaf.grad).all())
        assert float(leaf.grad.abs().max()) > 0


@pytest.mark.parametrize("columns", [3, 6])
def test_distances_of_neighbors_have_the_gradient_of_their_formula(columns):
    points, queries = (torch.rand(count, columns, generator=seeded(count)) for count in (60, 25))
    queries[:3] = points[:3]  # at distance 0
    ptr, queries_ptr = torch.tensor([0, 40, 42, 60]), torch.tensor([0, 15, 20, 25])
    asked = {"queries": queries, "queries_ptr": queries_ptr}
    found = {
        "knn": lambda p, q: F.knn(p, ptr, k=4, queries=q, queries_ptr=queries_ptr),
        "ball": lambda p, q: F.ball_query(p, ptr, radius=0.6, max_neighbors=5, queries=q, queries_ptr=queries_ptr)[:2],
        "all": lambda p, q: F.radius_neighbors(p, ptr, radius=0.6, queries=q, queries_ptr=queries_ptr)[:2],
    }
    for name, search in found.items():
        leaves = points.clone().requires_grad_(), queries.clone().requires_grad_()
        index, distance = search(*leaves)
        assert torch.equal(distance.detach(), search(points, queries)[1]), name
        there = index < len(points)
        gradients = torch.autograd.grad(distance[there].square().sum(), leaves)
        row = index[there]
        query = there.nonzero()[:, 0]
        if name == "all":
            query = F.radius_neighbors(points, ptr, radius=0.6, **asked)[2].diff()
            query = torch.repeat_interleave(torch.arange(len(queries)), query)
        offset = 2 * (points[row] - queries[query])
        wanted = torch.zeros_like(points).index_add(0, row, offset)
        torch.testing.assert_close(gradients[0], wanted, rtol=1e-4, atol=1e-6)
        wanted = torch.zeros_like(queries).index_add(0, query, -offset)
        torch.testing.assert_close(gradients[1], wanted, rtol=1e-4, atol=1e-6)


def test_directions_of_length_zero_poison_no_gradient():
    directions = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.6, 0.8]], requires_grad=True)
    turn = rigid.from_rotation_translation(
        rigid.rotation_about_axis(torch.tensor([0.0, 0, 1]), torch.tensor(0.3)), torch.ones(3)
    )
    moved = transform_directions(directions, torch.tensor([0, 2]), turn[None])
    assert torch.equal(moved[0].detach(), torch.zeros(3))
    moved.square().sum().backward()
    assert directions.grad is not None
    assert bool(torch.isfinite(directions.grad).all())


@pytest.mark.parametrize("twist", [[0.0] * 6, [0.0, 0.0, 0.3, 0.1, 0.2, 0.3], [0.0, 1e-9, 0.0, 0.0, 0.0, 0.0]])
def test_motions_have_a_gradient_at_rest_and_away_from_it(twist):
    pivot = torch.tensor([0.3, -0.1, 0.7], dtype=torch.float64)
    leaf = torch.tensor(twist, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda t: motion_from_twist(t, pivot), (leaf,), eps=1e-6, atol=1e-5)
    (back,) = torch.autograd.grad(twist_from_motion(motion_from_twist(leaf, pivot), pivot).sum(), leaf)
    torch.testing.assert_close(back, torch.ones(6, dtype=torch.float64), atol=1e-5, rtol=0)


def test_measuring_a_hole_or_a_flat_wall_has_a_finite_gradient():
    focal = INTRINSICS[:, :1, :1]
    for depth in (image().double(), torch.full((1, 12, 16), 0.8, dtype=torch.float64)):
        leaf = depth.clone().requires_grad_()
        measured = err_in_disparity(leaf, torch.zeros_like(depth), focal_baseline=focal * 0.05, sigma=0.1, step=0.0)
        (measured.sum() + surface_slope(leaf, focal).sum()).backward()
        assert leaf.grad is not None
        assert bool(torch.isfinite(leaf.grad).all())
