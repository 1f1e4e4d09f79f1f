"""The search in boxes: any number of neighbors, queries from anywhere, thousands of equal points, ragged batches."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pcdata import functional as F
from pcdata.rng import seeded
from tests import pretend_device
from tests.kernels.cuda import harness

pytestmark = pytest.mark.skipif(harness.unavailable() is not None, reason=str(harness.unavailable()))
harness.register()


def same(found: tuple[Tensor, ...], expected: tuple[Tensor, ...]) -> None:
    for one, other in zip(found, expected, strict=True):
        assert torch.equal(one, other)


def both(operation, *arguments, **options) -> tuple[Tensor, ...]:
    found = operation(*arguments, **options, backend=harness.BACKEND)
    same(found, operation(*arguments, **options, backend="torch"))
    return found


def cloud(count: int, seed: int = 0) -> Tensor:
    """Clusters of very different densities, and repeats."""
    generator = seeded(seed)
    points = torch.randn(count, 3, generator=generator) * 10.0 ** torch.randint(-4, 2, (count, 1), generator=generator)
    points[1::7] = points[::7][: len(points[1::7])]
    return points


@pytest.mark.parametrize("k", [1, 2, 8, 9, 16, 20, 33, 64, 65, 150])
def test_any_number_of_neighbors(k, ordered):
    both(F.knn, cloud(700), torch.tensor([0, 0, 90, 91, 700]), k=k)


@pytest.mark.parametrize("count", [1, 2, 31, 32, 33, 1023, 1025, 33_000])
def test_clouds_of_one_to_three_levels(count):
    points = torch.rand(count, 3, generator=seeded(count))
    queries = torch.rand(50, 3, generator=seeded(1)) * 1.4 - 0.2
    both(F.knn, points, k=5, queries=queries)


@pytest.mark.parametrize("radius", [1e-4, 0.01, 0.3, 50.0])
def test_within_a_radius_and_within_one_of_each_query(radius, ordered):
    points, ptr = cloud(500), torch.tensor([0, 200, 200, 500])
    both(F.ball_query, points, ptr, radius=radius, max_neighbors=12)
    queries, queries_ptr = cloud(90, seed=3), torch.tensor([0, 30, 31, 90])
    each = torch.rand(90, generator=seeded(5)) * radius + 1e-5
    both(F.ball_query, points, ptr, radius=each, max_neighbors=7, queries=queries, queries_ptr=queries_ptr)
    both(F.radius_neighbors, points, ptr, radius=min(radius, 0.3))


def test_queries_far_from_all_points(ordered):
    queries = cloud(100, seed=2) * 1e4
    both(F.knn, cloud(400), k=3, queries=queries)
    both(F.knn, cloud(400) * 1e18, k=3, queries=queries)


def test_thousands_of_points_in_one_place_give_the_lowest_rows():
    points = torch.zeros(3000, 3)
    points[::5] = torch.rand(600, 3, generator=seeded(0))
    index, _ = both(F.knn, points, k=6)
    assert index[1].tolist() == [1, 2, 3, 4, 6, 7]


@pytest.mark.parametrize("num_neighbors", [1, 2, 20, 70, 5000])
def test_statistical_outliers(num_neighbors, ordered):
    points = cloud(600)
    for ptr in ([0, 600], [0, 0, 1, 3, 600]):
        options = {"num_neighbors": num_neighbors, "std_ratio": 1.0}
        found = F.statistical_outlier_mask(points, torch.tensor(ptr), **options, backend=harness.BACKEND)
        expected = F.statistical_outlier_mask(points, torch.tensor(ptr), **options, backend="torch")
        assert torch.equal(found, expected)


def test_empty_clouds_and_no_queries():
    nothing = torch.zeros(0, 3)
    both(F.knn, nothing, torch.tensor([0, 0, 0]), k=3)
    both(F.knn, cloud(5), k=3, queries=nothing)
    both(F.knn, nothing, k=3, queries=cloud(5))


@pytest.mark.skipif(not pretend_device.AVAILABLE, reason="this PyTorch has no devices written in Python")
def test_a_search_never_waits_for_the_device(monkeypatch):
    device = harness.as_on_a_gpu(monkeypatch)
    points, ptr = torch.rand(500, 3, generator=seeded(2)).to(device), torch.tensor([0, 500]).to(device)
    F.knn(points, ptr, k=4)
    with pretend_device.watching() as watched:
        F.knn(points, ptr, k=4)
    assert [place for place in watched.waits if "kernels/cuda" in place] == []
    assert watched.launches < 30


@pytest.mark.parametrize(("radius", "most"), [(0.01, 30), (3.0, 12), (None, 5), (0.5, 64), (0.5, 65), (1e-6, 30)])
def test_normals(radius, most, ordered):
    points, ptr = cloud(400), torch.tensor([0, 0, 200, 202, 400])
    options = {"radius": radius, "max_neighbors": most}
    found = F.estimate_normals(points, ptr, **options, backend=harness.BACKEND)
    torch.testing.assert_close(found, F.estimate_normals(points, ptr, **options, backend="torch"), atol=2e-6, rtol=0)


def test_means_that_are_all_equal_are_told_apart_as_by_the_reference(ordered):
    turns = torch.arange(3000.0) * (2 * torch.pi / 3000)
    ring = torch.stack([turns.cos(), turns.sin(), torch.zeros(3000)], 1)
    lattice = torch.cartesian_prod(*[torch.arange(11.0)] * 3)
    for points, ptr in ((ring, [0, 3000]), (lattice, [0, 1331]), (torch.cat([ring, lattice]), [0, 3000, 4331])):
        options = {"num_neighbors": 3, "std_ratio": 1e-9}
        found = F.statistical_outlier_mask(points, torch.tensor(ptr), **options, backend=harness.BACKEND)
        assert torch.equal(found, F.statistical_outlier_mask(points, torch.tensor(ptr), **options, backend="torch"))
