"""An index that is made once gives the answers of the functions, bit for bit."""

from __future__ import annotations

import pickle

import pytest
import torch

from pcdata.errors import ConfigError, DTypeError, NonFiniteError, ShapeError
from pcdata.functional import NeighborIndex, ball_query, knn, radius_neighbors
from pcdata.functional.rows import ptr_from_counts
from pcdata.rng import seeded

COUNTS, ASKED = (300, 0, 37, 1, 520), (40, 3, 0, 5, 77)


def clouds(counts: tuple[int, ...], seed: int = 0, columns: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.rand(sum(counts), columns, generator=seeded(seed)), ptr_from_counts(list(counts))


def assert_equal(found: tuple[torch.Tensor, ...], expected: tuple[torch.Tensor, ...]) -> None:
    assert len(found) == len(expected)
    assert all(torch.equal(one, other) for one, other in zip(found, expected))


@pytest.mark.parametrize("columns", [2, 3, 5])
def test_every_question_is_answered_as_by_the_functions(columns):
    points, ptr = clouds(COUNTS, columns=columns)
    queries, queries_ptr = clouds(ASKED, seed=1, columns=columns)
    index = NeighborIndex(points, ptr)
    radii = 0.05 + 0.2 * torch.rand(len(queries), generator=seeded(2))
    for own in ({}, {"exclude_self": True}, {"queries": queries, "queries_ptr": queries_ptr}):
        for k in (1, 8, 90):
            assert_equal(index.knn(k=k, **own), knn(points, ptr, k=k, **own))
        assert_equal(
            index.ball_query(radius=0.2, max_neighbors=9, **own),
            ball_query(points, ptr, radius=0.2, max_neighbors=9, **own),
        )
        assert_equal(index.radius_neighbors(radius=0.2, **own), radius_neighbors(points, ptr, radius=0.2, **own))
    assert_equal(
        index.ball_query(radius=radii, max_neighbors=5, queries=queries, queries_ptr=queries_ptr),
        ball_query(points, ptr, radius=radii, max_neighbors=5, queries=queries, queries_ptr=queries_ptr),
    )


def test_points_in_one_place_are_answered_the_same():
    points = torch.cat([torch.zeros(1000, 3), torch.rand(200, 3, generator=seeded(0))])
    index, queries = NeighborIndex(points), torch.rand(30, 3, generator=seeded(1)) * 0.1
    for k in (3, 128, 129, 300):
        assert_equal(index.knn(k=k, queries=queries), knn(points, k=k, queries=queries))
    assert_equal(index.knn(k=4), knn(points, k=4))
    assert_equal(
        index.radius_neighbors(radius=0.1, queries=queries), radius_neighbors(points, radius=0.1, queries=queries)
    )


def test_distances_carry_gradients_to_points_and_queries():
    points, queries = (torch.rand(50, 3, generator=seeded(seed)).requires_grad_() for seed in (0, 1))
    found = torch.autograd.grad(NeighborIndex(points).knn(k=3, queries=queries)[1].sum(), (points, queries))
    assert_equal(found, torch.autograd.grad(knn(points, k=3, queries=queries)[1].sum(), (points, queries)))


def test_no_points_and_no_queries_are_answered():
    empty, queries = torch.zeros(0, 3), torch.rand(4, 3, generator=seeded(0))
    assert_equal(NeighborIndex(empty).knn(k=2, queries=queries), knn(empty, k=2, queries=queries))
    assert_equal(NeighborIndex(queries).knn(k=2, queries=empty), knn(queries, k=2, queries=empty))


def test_an_index_is_pickled_as_its_points():
    points, ptr = clouds(COUNTS)
    again = pickle.loads(pickle.dumps(NeighborIndex(points, ptr)))
    assert_equal(again.knn(k=3), knn(points, ptr, k=3))
    assert repr(again) == "NeighborIndex(5 clouds, 858 points of 3 columns)"


def test_what_does_not_fit_is_refused():
    points, ptr = clouds(COUNTS)
    index = NeighborIndex(points, ptr)
    with pytest.raises(NonFiniteError, match="NeighborIndex: points"):
        NeighborIndex(points / 0)
    with pytest.raises(ShapeError, match=r"NeighborIndex.knn: queries .*D=2"):
        index.knn(k=1, queries=torch.rand(3, 2))
    with pytest.raises(ShapeError, match=r"NeighborIndex.knn: .*B=1"):
        index.knn(k=1, queries=torch.rand(3, 3))
    with pytest.raises(ShapeError, match="without queries"):
        index.knn(k=1, queries_ptr=ptr)
    with pytest.raises(ConfigError, match=r"NeighborIndex\.ball_query: max_neighbors must be at least 1"):
        index.ball_query(radius=0.1, max_neighbors=0)
    with pytest.raises(ConfigError, match=r"NeighborIndex\.radius_neighbors: radius must be"):
        index.radius_neighbors(radius=-1.0)
    with pytest.raises(DTypeError, match=r"NeighborIndex\.knn: queries"):
        index.knn(k=1, queries=torch.rand(3, 3).double(), queries_ptr=torch.tensor([0, 3]))
    with pytest.raises(ConfigError, match="exclude_self means nothing for queries of their own"):
        NeighborIndex(points).knn(k=1, queries=points[:3], exclude_self=True)
