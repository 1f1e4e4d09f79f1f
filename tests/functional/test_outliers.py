"""Outlier masks against Open3D, brute force and hand-worked cases."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from pcdata.errors import ConfigError
from pcdata.functional.outliers import radius_outlier_mask, statistical_outlier_mask


def cloud_of_graspnet(folder: Path, num_points: int) -> Tensor:
    """A random subset of a real depth frame, in row-major pixel order, by NumPy alone."""
    image = pytest.importorskip("PIL.Image")
    loadmat = pytest.importorskip("scipy.io").loadmat
    depth = np.asarray(image.open(folder / "graspnet_frame" / "depth.png")).astype(np.float64) / 1000.0
    matrix = loadmat(folder / "graspnet_frame" / "meta.mat")["intrinsic_matrix"]
    v, u = np.nonzero(depth)
    z = depth[v, u]
    points = np.column_stack([(u - matrix[0, 2]) * z / matrix[0, 0], (v - matrix[1, 2]) * z / matrix[1, 1], z])
    chosen = np.sort(np.random.default_rng(0).permutation(len(points))[:num_points])
    return torch.from_numpy(points[chosen].astype(np.float32))


def open3d_cloud(points: Tensor):
    open3d = pytest.importorskip("open3d")
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.double().numpy()))


def removed(kept: list[int], num_points: int) -> Tensor:
    mask = torch.ones(num_points, dtype=torch.bool)
    mask[torch.as_tensor(np.asarray(kept), dtype=torch.int64)] = False
    return mask


def test_a_far_point_is_an_outlier_and_its_cloud_is_not():
    points = torch.cat([torch.rand(200, 3), torch.tensor([[10.0, 0, 0]])])
    assert statistical_outlier_mask(points).nonzero().flatten().tolist() == [200]
    assert radius_outlier_mask(points, radius=1.0).nonzero().flatten().tolist() == [200]


def test_statistical_mask_equals_its_definition():
    points = torch.from_numpy(np.random.default_rng(0).standard_cauchy((300, 3)).astype(np.float32))
    mean = torch.cdist(points.double(), points.double()).sort(1).values[:, :10].mean(1)
    expected = mean >= mean.mean() + 1.5 * mean.std()
    assert expected.any()
    assert torch.equal(statistical_outlier_mask(points, num_neighbors=10, std_ratio=1.5), expected)


def test_statistical_edge_cases_are_those_of_open3d():
    assert statistical_outlier_mask(torch.rand(1, 3)).tolist() == [True]  # no sample deviation of one mean
    assert statistical_outlier_mask(torch.rand(2, 3)).tolist() == [True, True]  # equal means: nothing is below mu
    assert statistical_outlier_mask(torch.zeros(30, 3)).all()  # mean 0 is not a distance
    assert statistical_outlier_mask(torch.rand(9, 3), num_neighbors=1).all()
    assert statistical_outlier_mask(torch.zeros(0, 3)).shape == (0,)


def test_radius_counts_the_point_itself_and_both_tests_are_strict():
    points = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [0.5, 0, 0]])
    assert radius_outlier_mask(points, min_neighbors=1, radius=1.0).tolist() == [False, False, False]
    assert radius_outlier_mask(points, min_neighbors=2, radius=1.0).tolist() == [True, True, False]
    assert radius_outlier_mask(points, min_neighbors=3, radius=1.0).all()


@pytest.mark.parametrize("spacing", [0.02, 0.2, 2.0])
def test_radius_mask_equals_brute_force_from_dense_to_sparse(spacing: float):
    points = torch.from_numpy(np.random.default_rng(1).normal(size=(600, 3)).astype(np.float32)) * spacing
    offset = points[:, None] - points[None]
    square = offset * offset
    count = (((square[..., 0] + square[..., 1]) + square[..., 2]) < torch.tensor(0.1) * torch.tensor(0.1)).sum(1)
    assert torch.equal(radius_outlier_mask(points, min_neighbors=4, radius=0.1), count <= 4)


@pytest.mark.parametrize("function", [statistical_outlier_mask, radius_outlier_mask])
def test_a_batch_equals_its_clouds_alone(function):
    clouds = [torch.rand(n, 3) * 0.05 for n in (120, 0, 1, 64)]
    ptr = torch.tensor([0, 120, 120, 121, 185])
    together = function(torch.cat(clouds), ptr)
    assert torch.equal(together, torch.cat([function(cloud) for cloud in clouds]))


def test_metres_and_millimetres_give_one_mask():
    points = torch.from_numpy(np.random.default_rng(2).normal(size=(500, 3)).astype(np.float32))
    assert torch.equal(
        radius_outlier_mask(points, radius=0.25), radius_outlier_mask(points * 1024.0, radius=0.25 * 1024)
    )
    assert torch.equal(statistical_outlier_mask(points), statistical_outlier_mask(points * 1024.0))


def test_a_stray_point_a_thousand_kilometres_out_changes_nothing_else():
    points = torch.rand(400, 3) * 0.1
    stray = torch.cat([points, torch.full((1, 3), 1e6)])
    assert torch.equal(radius_outlier_mask(stray)[:-1], radius_outlier_mask(points))
    assert radius_outlier_mask(stray)[-1]


def test_a_radius_beyond_64_bit_cells_is_an_error():
    points = torch.tensor([[0.0, 0, 0], [1e6, 0, 0]])
    with pytest.raises(ConfigError, match="same unit"):
        radius_outlier_mask(points, radius=1e-7)


def test_bad_numbers_raise():
    with pytest.raises(ConfigError, match="num_neighbors"):
        statistical_outlier_mask(torch.rand(3, 3), num_neighbors=0)
    with pytest.raises(ConfigError, match="std_ratio"):
        statistical_outlier_mask(torch.rand(3, 3), std_ratio=0.0)
    with pytest.raises(ConfigError, match="radius"):
        radius_outlier_mask(torch.rand(3, 3), radius=0.0)


@pytest.mark.open3d
@settings(max_examples=20, deadline=None)
@given(
    num_points=st.integers(1, 80),
    copies=st.integers(1, 30),
    num_neighbors=st.integers(1, 25),
    ratio=st.sampled_from([0.5, 1.0, 2.0]),
    seed=st.integers(0, 2**16),
)
def test_statistical_mask_equals_open3d_with_duplicates(
    num_points: int, copies: int, num_neighbors: int, ratio: float, seed: int
):
    points = torch.from_numpy(np.random.default_rng(seed).normal(size=(num_points, 3)).astype(np.float32))
    points = torch.cat([points, points[:1].expand(copies, 3)])
    _, kept = open3d_cloud(points).remove_statistical_outlier(num_neighbors, ratio)
    mask = statistical_outlier_mask(points, num_neighbors=num_neighbors, std_ratio=ratio)
    expected = removed(kept, len(points))
    # Means that are equal but for rounding (all points alike) are a coin toss in both libraries.
    distances = torch.cdist(points.double(), points.double()).sort(1).values[:, :num_neighbors].mean(1)
    threshold = (
        distances.mean()
        + ratio * ((distances - distances.mean()) ** 2 * (distances > 0)).sum().div(max(1, len(points) - 1)).sqrt()
    )
    clear = ((distances - threshold).abs() > 1e-6) | (distances == 0)
    assert torch.equal(mask[clear], expected[clear])


@pytest.mark.open3d
def test_masks_equal_open3d_on_a_real_frame(test_data: Path):
    points = cloud_of_graspnet(test_data, 100_000)
    cloud = open3d_cloud(points)
    _, kept = cloud.remove_statistical_outlier(20, 2.0)
    assert torch.equal(statistical_outlier_mask(points), removed(kept, len(points)))
    _, kept = cloud.remove_radius_outlier(5, 0.01)
    assert torch.equal(radius_outlier_mask(points), removed(kept, len(points)))
