"""Exact neighbor search against brute force and SciPy, on easy and on hostile clouds."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from torch import Tensor

from pcdata.errors import ConfigError, DTypeError, NonFiniteError, ShapeError
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.neighbors import ball_query, knn, radius_neighbors
from pcdata.rng import seeded


def brute_force(points: Tensor, ptr: Tensor, queries: Tensor, queries_ptr: Tensor, k: int, radius: float | None = None):
    """Sort every (squared distance, row) of the query's cloud: the contract, word for word."""
    index = torch.full((len(queries), k), len(points))
    distance = torch.full((len(queries), k), torch.inf)
    for b in range(len(ptr) - 1):
        rows = torch.arange(int(ptr[b]), int(ptr[b + 1]))
        for q in range(int(queries_ptr[b]), int(queries_ptr[b + 1])):
            offset = queries[q] - points[rows]
            square = offset * offset
            squared = (square[:, 0] + square[:, 1]) + square[:, 2]
            order = sorted(range(len(rows)), key=lambda i: (float(squared[i]), i))
            if radius is not None:
                limit = torch.tensor(radius) * torch.tensor(radius)
                order = [i for i in order if squared[i] < limit]
            for j, i in enumerate(order[:k]):
                index[q, j], distance[q, j] = rows[i], squared[i].double().sqrt().float()
    return index, distance


def random_clouds(seed: int, counts: list[int], style: str = "uniform") -> tuple[Tensor, Tensor]:
    generator = np.random.default_rng(seed)
    n = sum(counts)
    points = generator.normal(size=(n, 3))
    if style == "lattice":  # full of ties
        points = generator.integers(0, 4, size=(n, 3)).astype(float)
    elif style == "duplicates":
        points = points[generator.integers(0, max(1, n // 6), size=n)] if n else points
    elif style == "line":
        points[:, 1:] = 0
    elif style == "stray":  # one point a thousand kilometres from a millimetre cloud
        points *= 1e-3
        points[: n // 10] += 1e6
    elif style == "equal":
        points[:] = 0.25
    ptr = torch.from_numpy(np.concatenate([[0], np.cumsum(counts)]).astype(np.int64))
    return torch.from_numpy(points.astype(np.float32)), ptr


STYLES = ["uniform", "lattice", "duplicates", "line", "stray", "equal"]


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("k", [1, 5, 40])
def test_knn_equals_brute_force_ties_and_padding_included(style: str, k: int):
    points, ptr = random_clouds(1, [70, 0, 1, 130, 17, 3], style)
    index, distance = knn(points, ptr, k=k)
    expected_index, expected_distance = brute_force(points, ptr, points, ptr, k)
    assert torch.equal(index, expected_index)
    assert torch.equal(distance, expected_distance)


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("k", [1, 7])
def test_knn_from_other_queries_equals_brute_force(style: str, k: int):
    points, ptr = random_clouds(2, [60, 0, 90, 5], style)
    queries, queries_ptr = random_clouds(3, [20, 3, 0, 25], style)
    found = knn(points, ptr, k=k, queries=queries, queries_ptr=queries_ptr)
    expected = brute_force(points, ptr, queries, queries_ptr, k)
    assert torch.equal(found[0], expected[0])
    assert torch.equal(found[1], expected[1])


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("radius", [1e-3, 1.0, 2.0])
def test_ball_query_returns_the_nearest_within_the_radius(style: str, radius: float):
    points, ptr = random_clouds(4, [80, 0, 60], style)
    index, distance, count = ball_query(points, ptr, radius=radius, max_neighbors=6)
    expected_index, expected_distance = brute_force(points, ptr, points, ptr, 6, radius)
    assert torch.equal(index, expected_index)
    assert torch.equal(distance, expected_distance)
    assert torch.equal(count, (expected_index < len(points)).sum(1))


def test_ball_query_is_strict_at_the_radius():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.5, 0, 0]])
    index, _, count = ball_query(points, radius=1.0, max_neighbors=3)
    assert count.tolist() == [2, 2, 3]
    assert index[0].tolist() == [0, 2, 3]


def test_equal_distances_go_to_the_lowest_row():
    points = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 0]])
    index, _ = knn(points, k=3)
    assert index[3].tolist() == [3, 0, 1]


def test_padding_fails_loudly_in_an_unmasked_gather():
    points = torch.rand(3, 3)
    index, distance = knn(points, k=5)
    assert (index[:, 3:] == 3).all()
    assert torch.isinf(distance[:, 3:]).all()
    with pytest.raises(IndexError):
        points[index]


@pytest.mark.parametrize("k", [1, 20, 100])
def test_knn_distances_equal_scipy_on_a_large_surface(k: int):
    scipy_spatial = pytest.importorskip("scipy.spatial")
    generator = np.random.default_rng(0)
    xy = generator.uniform(-1, 1, size=(8000, 2))
    points = np.column_stack([xy, np.sin(3 * xy[:, 0])]).astype(np.float32)
    points[:50] *= 30.0  # isolated points far from the rest
    distance = knn(torch.from_numpy(points), k=k)[1].double().numpy()
    expected = scipy_spatial.cKDTree(points.astype(np.float64)).query(points, k=[*range(1, k + 1)])[0]
    np.testing.assert_allclose(distance, expected, rtol=1e-5, atol=1e-6)


def test_a_batch_equals_its_clouds_alone():
    points, ptr = random_clouds(5, [50, 0, 33, 1])
    index, distance = knn(points, ptr, k=4)
    for b in range(4):
        rows = slice(int(ptr[b]), int(ptr[b + 1]))
        alone_index, alone_distance = knn(points[rows], k=4)
        shifted = torch.where(alone_index < rows.stop - rows.start, alone_index + rows.start, len(points))
        assert torch.equal(index[rows], shifted)
        assert torch.equal(distance[rows], alone_distance)


def test_moving_rows_moves_the_answer():
    points, _ = random_clouds(6, [200])
    order = torch.from_numpy(np.random.default_rng(0).permutation(200))
    index, distance = knn(points, k=6)
    moved_index, moved_distance = knn(points[order], k=6)
    assert torch.equal(order[moved_index], index[order])
    assert torch.equal(moved_distance, distance[order])


@settings(max_examples=25, deadline=None)
@given(
    counts=st.lists(st.integers(0, 40), min_size=1, max_size=4),
    style=st.sampled_from(STYLES),
    exponent=st.sampled_from([-12, -3, 0, 6, 12]),
    k=st.integers(1, 24),
    seed=st.integers(0, 2**16),
)
def test_knn_equals_brute_force_at_any_scale(counts: list[int], style: str, exponent: int, k: int, seed: int):
    points, ptr = random_clouds(seed, counts, style)
    points = points * 10.0**exponent
    index, distance = knn(points, ptr, k=k)
    expected_index, expected_distance = brute_force(points, ptr, points, ptr, k)
    assert torch.equal(index, expected_index)
    assert torch.equal(distance, expected_distance)


def test_many_equal_points_stay_cheap_and_exact():
    points = torch.cat([torch.zeros(30_000, 3), torch.rand(500, 3)])
    index, distance = knn(points, k=8)
    assert torch.equal(index[:30_000], torch.arange(8).expand(30_000, 8))
    assert not distance[:30_000].any()


def test_bad_arguments_raise_typed_errors():
    points = torch.rand(5, 3)
    with pytest.raises(ConfigError, match="k must be at least 1"):
        knn(points, k=0)
    with pytest.raises(DTypeError, match="k must be an int"):
        knn(points, k=2.0)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="radius must be a length"):
        ball_query(points, radius=-1.0, max_neighbors=3)
    with pytest.raises(ConfigError, match="radius must be a length"):
        ball_query(points, radius=float("nan"), max_neighbors=3)
    with pytest.raises(ShapeError, match="queries_ptr was given without queries"):
        knn(points, k=1, queries_ptr=torch.tensor([0, 5]))
    with pytest.raises(ShapeError, match="must agree"):
        knn(points, torch.tensor([0, 2, 5]), k=1, queries=points)
    with pytest.raises(NonFiniteError):
        knn(torch.full((2, 3), torch.nan), k=1)


def test_a_grid_that_does_not_describe_the_points_raises():
    points = torch.rand(4, 3)
    intrinsics = torch.eye(3)[None]
    good = ImageGrid(torch.tensor([0, 3, 4, 11]), (3, 4), intrinsics)
    assert torch.equal(knn(points, k=2, grid=good)[0], knn(points, k=2)[0])
    for pixels in ([0, 3, 4], [0, 4, 3, 5], [0, 3, 4, 12], [-1, 0, 1, 2]):
        with pytest.raises(ShapeError, match="grid"):
            knn(points, k=2, grid=ImageGrid(torch.tensor(pixels), (3, 4), intrinsics))
    restart = ImageGrid(torch.tensor([5, 6, 0, 1]), (3, 4), intrinsics.expand(2, 3, 3))
    knn(points, torch.tensor([0, 2, 4]), k=2, grid=restart)


@pytest.mark.parametrize("columns", [1, 2, 5, 6])
def test_neighbors_in_any_number_of_columns_are_scipys(columns):
    points, queries = (torch.rand(count, columns, generator=seeded(count)) for count in (300, 40))
    distance, index = cKDTree(points.double().numpy()).query(queries.double().numpy(), k=7)
    found, apart = knn(points, k=7, queries=queries)
    assert torch.equal(found, torch.from_numpy(index))
    torch.testing.assert_close(apart.double(), torch.from_numpy(distance), rtol=1e-5, atol=1e-6)


def test_all_neighbors_within_a_radius_are_scipys_per_query():
    points, queries = (torch.rand(count, 3, generator=seeded(count)) for count in (900, 60))
    points[500:] = points[:400]  # repeats, so that tables grow
    radius = torch.linspace(0.02, 0.6, 60, dtype=torch.float64)
    index, distance, ptr = radius_neighbors(points, radius=radius, queries=queries)
    wanted = cKDTree(points.double().numpy()).query_ball_point(
        queries.double().numpy(), radius.numpy(), return_sorted=True
    )
    for query, (start, stop) in enumerate(pairwise(ptr.tolist())):
        assert sorted(index[start:stop].tolist()) == sorted(wanted[query])
        assert bool((distance[start:stop].diff() >= 0).all())
    near, apart, count = ball_query(points, radius=radius, max_neighbors=900, queries=queries)
    there = near < len(points)
    assert torch.equal(count, ptr.diff())
    assert torch.equal(near[there], index)
    assert torch.equal(apart[there], distance)


def test_a_point_is_left_out_of_its_own_neighbors_but_its_repeats_are_not():
    points = torch.tensor([[0.0, 0, 0], [0, 0, 0], [0, 0, 0], [1, 0, 0]])
    assert knn(points, k=1, exclude_self=True)[0].tolist() == [[1], [0], [0], [0]]
    assert knn(points, k=2, exclude_self=True)[0].tolist() == [[1, 2], [0, 2], [0, 1], [0, 1]]
    index, distance, count = ball_query(points, radius=0.5, max_neighbors=2, exclude_self=True)
    assert index.tolist() == [[1, 2], [0, 2], [0, 1], [4, 4]]
    assert count.tolist() == [2, 2, 2, 0]
    assert distance[3].tolist() == [float("inf")] * 2
    flat, _, ptr = radius_neighbors(points, radius=0.5, exclude_self=True)
    assert flat.tolist() == [1, 2, 0, 2, 0, 1]
    assert ptr.tolist() == [0, 2, 4, 6, 6]
    for search in (knn, ball_query, radius_neighbors):
        options = {"k": {"k": 1}, "b": {"radius": 1.0, "max_neighbors": 1}, "r": {"radius": 1.0}}[search.__name__[0]]
        with pytest.raises(ConfigError, match=rf"^{search.__name__}: exclude_self means nothing"):
            search(points, queries=points, exclude_self=True, **options)


def test_radii_per_query_are_held_to_the_queries():
    points = torch.rand(9, 3, generator=seeded(0))
    with pytest.raises(ShapeError, match=r"radius must be one number or one per query \(9,\)"):
        radius_neighbors(points, radius=torch.ones(8))
    with pytest.raises(ConfigError, match="radius must be a length"):
        radius_neighbors(points, radius=torch.zeros(9))
    with pytest.raises(DTypeError, match="radius must be float"):
        ball_query(points, radius=torch.ones(9, dtype=torch.int64), max_neighbors=2)
