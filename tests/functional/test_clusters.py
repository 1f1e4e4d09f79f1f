"""DBSCAN against the textbook algorithm and Open3D."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from pcdata import functional as F
from pcdata.errors import ConfigError
from pcdata.functional.clusters import dbscan


def textbook_dbscan(points: Tensor, eps: float, min_points: int) -> Tensor:
    """Ester's algorithm on the full distance matrix, row by row."""
    offset = points[:, None] - points[None]
    square = offset * offset
    near = ((square[..., 0] + square[..., 1]) + square[..., 2]) < torch.tensor(eps) * torch.tensor(eps)
    core = near.sum(1) >= min_points
    label = torch.full((len(points),), -1)
    next_label = 0
    for seed in core.nonzero().flatten().tolist():
        if label[seed] >= 0:
            continue
        queue = [seed]
        while queue:
            row = queue.pop()
            if label[row] >= 0:
                continue
            label[row] = next_label
            if core[row]:
                queue += (near[row] & (label < 0)).nonzero().flatten().tolist()
        next_label += 1
    return label


def blobs(seed: int, num_points: int, spread: float) -> Tensor:
    generator = np.random.default_rng(seed)
    centers = generator.uniform(-1, 1, size=(4, 3))
    points = centers[generator.integers(0, 4, size=num_points)] + spread * generator.normal(size=(num_points, 3))
    return torch.from_numpy(points.astype(np.float32))


@pytest.mark.parametrize("spread", [0.02, 0.1, 0.3])
@pytest.mark.parametrize(("eps", "min_points"), [(0.05, 1), (0.1, 4), (0.2, 12), (3.0, 5)])
def test_labels_equal_the_textbook_algorithm(spread: float, eps: float, min_points: int):
    points = blobs(0, 400, spread)
    assert torch.equal(dbscan(points, eps=eps, min_points=min_points), textbook_dbscan(points, eps, min_points))


@settings(max_examples=25, deadline=None)
@given(
    num_points=st.integers(0, 120),
    eps=st.floats(0.02, 1.0),
    min_points=st.integers(1, 12),
    lattice=st.booleans(),
    seed=st.integers(0, 2**16),
)
def test_labels_equal_the_textbook_algorithm_on_any_small_cloud(
    num_points: int, eps: float, min_points: int, lattice: bool, seed: int
):
    points = blobs(seed, num_points, 0.2)
    if lattice:  # duplicates, and distances equal to eps
        points, eps = (points * 4).round() / 4, 0.25
    assert torch.equal(dbscan(points, eps=eps, min_points=min_points), textbook_dbscan(points, eps, min_points))


def test_a_border_point_takes_the_lowest_label_in_reach():
    # Cores at x = 1 and x = 0, each with three followers; x = 0.5 has both cores in reach and is not core itself.
    x = torch.tensor([1.0, 1.4, 1.2, 0.0, -0.4, -0.2, 0.5])
    points = torch.stack([x, torch.zeros(7), torch.zeros(7)], dim=1)
    assert dbscan(points, eps=0.51, min_points=4).tolist() == [0, 0, 0, 1, 1, 1, 0]
    order = torch.tensor([3, 4, 5, 0, 1, 2, 6])
    assert dbscan(points[order], eps=0.51, min_points=4).tolist() == [0, 0, 0, 1, 1, 1, 0]


def test_eps_is_strict_and_the_count_includes_the_point_itself():
    pair = torch.tensor([[0.0, 0, 0], [1.0, 0, 0]])
    assert dbscan(pair, eps=1.0, min_points=1).tolist() == [0, 1]
    assert dbscan(pair, eps=1.0, min_points=2).tolist() == [-1, -1]
    assert dbscan(pair, eps=1.001, min_points=2).tolist() == [0, 0]


def test_labels_start_at_zero_in_every_cloud():
    clouds = [blobs(n, n, 0.05) for n in (150, 0, 1, 90, 200)]
    ptr = torch.tensor([0, 150, 150, 151, 241, 441])
    together = dbscan(torch.cat(clouds), ptr, eps=0.1, min_points=4)
    assert torch.equal(together, torch.cat([dbscan(cloud, eps=0.1, min_points=4) for cloud in clouds]))


def test_a_long_chain_of_cells_is_one_cluster_in_any_row_order():
    line = torch.zeros(3000, 3)
    line[:, 0] = torch.arange(3000) * 0.9
    order = torch.from_numpy(np.random.default_rng(0).permutation(3000))
    assert not dbscan(line[order], eps=1.0, min_points=2).any()


def test_dense_sheets_just_out_of_reach_stay_apart():
    sheet = torch.rand(4000, 3) * torch.tensor([1.0, 1.0, 0.0])
    other = sheet + torch.tensor([0.0, 0.0, 0.101])
    labels = dbscan(torch.cat([sheet, other]), eps=0.1, min_points=5)
    assert labels[:4000].unique().tolist() == [0]
    assert labels[4000:].unique().tolist() == [1]


def test_sheets_that_touch_at_one_pair_are_one_cluster():
    generator = torch.Generator().manual_seed(0)
    sheet = torch.rand(4000, 3, generator=generator) * torch.tensor([1.0, 1.0, 0.0])
    other = sheet + torch.tensor([0.0, 0.0, 0.101])
    other[77, 2] = 0.0995
    assert not dbscan(torch.cat([sheet, other]), eps=0.1, min_points=5).any()


def test_a_kilometre_scene_with_centimetre_eps_works():
    points = torch.cat([blobs(1, 200, 0.001), blobs(2, 200, 0.001) + 1e6 * torch.tensor([1.0, 0.0, 0.0])])
    labels = dbscan(points, eps=0.02, min_points=5)
    assert torch.equal(labels, textbook_dbscan(points, 0.02, 5))


def test_bad_numbers_raise():
    with pytest.raises(ConfigError, match="min_points"):
        dbscan(torch.rand(3, 3), min_points=0)
    with pytest.raises(ConfigError, match="eps"):
        dbscan(torch.rand(3, 3), eps=0.0)


@pytest.mark.open3d
@pytest.mark.parametrize(("eps", "min_points"), [(0.02, 50), (0.01, 10)])
def test_labels_equal_open3d_on_a_real_frame_border_points_too(frame_points: torch.Tensor, eps: float, min_points: int):
    open3d = pytest.importorskip("open3d")
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(frame_points.double().numpy()))
    expected = torch.from_numpy(np.asarray(cloud.cluster_dbscan(eps, min_points))).long()
    assert torch.equal(dbscan(frame_points, eps=eps, min_points=min_points), expected)


def heaps(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    centers = torch.rand(5, 3, generator=generator)
    return centers.repeat(24, 1) + 0.05 * torch.randn(120, 3, generator=generator)


@pytest.mark.parametrize("seed", range(3))
def test_a_weight_counts_as_so_many_points_in_one_place(seed):
    points, times = heaps(seed), torch.randint(0, 4, (120,), generator=torch.Generator().manual_seed(seed))
    times = times.clamp(min=1)
    repeated = points.repeat_interleave(times, 0)
    first = times.cumsum(0) - times
    for min_points in (4, 9):
        options = {"eps": 0.06, "min_points": min_points}
        weighted = F.dbscan(points, weights=times.float(), **options)
        assert torch.equal(weighted, F.dbscan(repeated, **options)[first])
        core = F.core_point_mask(points, weights=times.float(), **options)
        assert torch.equal(core, F.core_point_mask(repeated, **options)[first])
        assert torch.equal(F.dbscan(points, weights=torch.ones(120), **options), F.dbscan(points, **options))


def test_core_points_have_enough_neighbors_and_every_cloud_its_own_eps():
    points, ptr, eps = torch.cat([heaps(1), heaps(2)]), torch.tensor([0, 120, 240]), [0.04, 0.08]
    core = F.core_point_mask(points, ptr, eps=eps, min_points=6)
    labels = F.dbscan(points, ptr, eps=eps, min_points=6)
    for b, part in enumerate((slice(0, 120), slice(120, 240))):
        near = torch.cdist(points[part].double(), points[part].double()) < eps[b]
        assert torch.equal(core[part], near.sum(1) >= 6)
        assert torch.equal(labels[part], F.dbscan(points[part], eps=eps[b], min_points=6))
    assert bool((labels[core] >= 0).all())
    assert bool(core.any())
    assert not bool(core.all())
