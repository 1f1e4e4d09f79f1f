"""The tree of boxes and the cells give bit for bit what looking at every pair gives."""

from __future__ import annotations

import pytest
import torch

from pcdata import functional as F
from pcdata.contracts.dispatch import OPERATIONS, why_unavailable
from pcdata.errors import ConfigError
from pcdata.functional.rows import ptr_from_counts
from pcdata.rng import seeded

COUNTS = [(250, 0, 90), (1, 2, 3), (0, 0)]
SHAPES = {
    "uniform": lambda points: points,
    "plane": lambda points: points * torch.tensor([1.0, 1.0, 0.0]),
    "line": lambda points: points * torch.tensor([1.0, 0.0, 0.0]),
    "repeats": lambda points: (points * 8).round() / 8,
    "far": lambda points: points + 1000.0,
    "uneven": lambda points: points * torch.tensor([1e-3, 1.0, 1e3]),
    "one_spot": lambda points: points * 0.0 + 0.3,
    "one_stray": lambda points: torch.cat([points[:-1], points[-1:] * 1e4]),
}


def batch(shape: str, counts: tuple[int, ...]):
    clouds = [SHAPES[shape](torch.rand(count, 3, generator=seeded(seed))) for seed, count in enumerate(counts)]
    return torch.cat(clouds), ptr_from_counts(counts)


def assert_both_equal(function, *args, **options):
    ours, theirs = (function(*args, **options, backend=backend) for backend in ("torch_tree", "torch"))
    pairs = zip(ours, theirs, strict=True) if isinstance(ours, tuple) else [(ours, theirs)]
    for one, other in pairs:
        assert one.dtype == other.dtype
        assert torch.equal(one.nan_to_num(), other.nan_to_num()), (function.__name__, options)


@pytest.mark.parametrize("shape", SHAPES)
def test_the_tree_gives_what_all_pairs_give(shape):
    for counts in COUNTS:
        points, ptr = batch(shape, counts)
        queries, queries_ptr = batch("uniform", tuple(count // 2 + 1 for count in counts))
        for others in ({}, {"queries": queries, "queries_ptr": queries_ptr}):
            for k in (1, 30, 300):
                assert_both_equal(F.knn, points, ptr, k=k, **others)
            assert_both_equal(F.ball_query, points, ptr, radius=0.1, max_neighbors=8, **others)
        for radius in (0.02, 0.5):
            assert_both_equal(F.dbscan, points, ptr, eps=radius, min_points=5)
            assert_both_equal(F.radius_outlier_mask, points, ptr, radius=radius, min_neighbors=5)
            assert_both_equal(F.estimate_normals, points, ptr, radius=radius, max_neighbors=12)
        assert_both_equal(F.statistical_outlier_mask, points, ptr, num_neighbors=10)
        if min(counts):
            assert_both_equal(F.chamfer_distance, points, ptr, queries, queries_ptr)


def test_more_neighbors_than_there_are_points_are_not_looked_for(monkeypatch):
    points, ptr = torch.rand(2000, 3, generator=seeded(0)), ptr_from_counts([1200, 800])
    expected = F.radius_outlier_mask(points, ptr, min_neighbors=1200, radius=2.0, backend="torch")
    assert expected.all()
    monkeypatch.delattr("pcdata.kernels.torch_tree.outliers.nearest_chunks")
    for enough in (1200, 10**6, 10**12):
        found = F.radius_outlier_mask(points, ptr, min_neighbors=enough, radius=2.0, backend="torch_tree")
        assert torch.equal(found, expected)


def test_both_refuse_a_radius_too_small_for_the_cloud():
    points = torch.tensor([[0.0, 0.0, 0.0], [1e9, 0.0, 0.0]])
    for backend in ("torch_tree", "torch"):
        with pytest.raises(ConfigError, match=r"radius_outlier_mask: a radius of 0.0001 cuts"):
            F.radius_outlier_mask(points, radius=1e-4, backend=backend)
        with pytest.raises(ConfigError, match=r"dbscan: a radius of 0.0001 cuts"):
            F.dbscan(points, eps=1e-4, min_points=1, backend=backend)


def test_a_gradient_comes_through_the_tree():
    points, targets = torch.rand(50, 3, generator=seeded(1)), torch.rand(40, 3, generator=seeded(2))
    found = []
    for backend in ("torch", "torch_tree", "auto"):
        leaf = points.clone().requires_grad_()
        F.chamfer_distance(leaf, None, targets, None, backend=backend).sum().backward()
        found.append(leaf.grad)
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[0], found[2])
    assert bool((found[0] != 0).any())


_SEARCHES = (
    "boundary_mask",
    "core_point_mask",
    "iterate_closest_points",
    "neighborhood_covariance",
    "radius_neighbors",
)


def test_the_tree_serves_every_search():
    assert why_unavailable("torch_tree") is None
    served = {name for name, operation in OPERATIONS.items() if operation.serves("torch_tree")}
    searches = {"knn", "ball_query", "chamfer_distance", "statistical_outlier_mask", "radius_outlier_mask"}
    searches |= {"dbscan", "estimate_normals", "f_score", "hausdorff_distance", "interpolate_features"}
    assert served == searches | {*_SEARCHES}


def test_looking_at_every_pair_takes_memory_for_a_bounded_number_of_them(monkeypatch):
    import pcdata.functional.nearest as nearest

    seen = []
    distance = nearest._all_squared
    monkeypatch.setattr(nearest, "_all_squared", lambda a, b: seen.append(len(a) * len(b)) or distance(a, b))
    points = torch.rand(3000, 3, generator=seeded(3))
    F.knn(points, k=3, backend="torch")
    assert sum(seen) == 3000 * 3000
    assert max(seen) <= 1 << 20
