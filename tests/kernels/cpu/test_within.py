"""All neighbors within a radius, and a radius per query, compiled: equal to the reference bit for bit."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from pcdata import functional as F
from pcdata.contracts.dispatch import why_unavailable
from pcdata.functional.rows import ptr_from_counts
from tests.kernels.cpu.test_neighbors import MANY, MANY_PTR, random_cloud

pytestmark = pytest.mark.skipif(why_unavailable("cpu") is not None, reason=str(why_unavailable("cpu")))


def assert_equal(search: Any, points: Tensor, ptr: Tensor | None = None, **options: Any) -> None:
    ours, theirs = (search(points, ptr, backend=name, **options) for name in ("cpu", "torch"))
    for a, b in zip(ours, theirs, strict=True):
        assert a.dtype == b.dtype
        assert torch.equal(a, b)


def radii(count: int, scale: float, seed: int = 0) -> Tensor:
    return scale * (0.05 + torch.rand(count, generator=torch.Generator().manual_seed(seed)))


@pytest.mark.parametrize("scale", [1e-13, 1e3, 9e18])
def test_lengths_of_any_size_list_as_the_reference_does(scale: float):
    points, ptr = MANY[MANY_PTR[-9] :], MANY_PTR[-9:] - MANY_PTR[-9]
    assert_equal(F.radius_neighbors, points, ptr, radius=scale)
    assert_equal(F.radius_neighbors, points, ptr, radius=radii(len(points), scale), exclude_self=True)


@pytest.mark.parametrize("exclude_self", [False, True])
def test_a_ragged_batch_is_listed_as_by_the_reference(instruction_set: str, exclude_self: bool):
    options = {"exclude_self": exclude_self}
    assert_equal(F.radius_neighbors, MANY, MANY_PTR, radius=0.2, **options)
    assert_equal(F.radius_neighbors, MANY, MANY_PTR, radius=radii(len(MANY), 0.4), **options)
    assert_equal(F.ball_query, MANY, MANY_PTR, radius=radii(len(MANY), 4.0), max_neighbors=60, **options)


@pytest.mark.parametrize("spread", [0.0, 1.0, 1e4])
def test_queries_of_their_own_have_radii_of_their_own(spread: float, instruction_set: str):
    counts = [(7 * cloud) % 23 for cloud in range(len(MANY_PTR) - 1)]
    queries = random_cloud(sum(counts), 5, spread)
    own = {"queries": queries, "queries_ptr": ptr_from_counts(counts), "radius": radii(len(queries), 0.5 + spread)}
    assert_equal(F.radius_neighbors, MANY, MANY_PTR, **own)
    assert_equal(F.ball_query, MANY, MANY_PTR, max_neighbors=11, **own)
    index = F.NeighborIndex(MANY, MANY_PTR)
    for ours, theirs in (
        (index.radius_neighbors(**own), F.radius_neighbors(MANY, MANY_PTR, **own)),
        (index.ball_query(max_neighbors=11, **own), F.ball_query(MANY, MANY_PTR, max_neighbors=11, **own)),
    ):
        assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))


@pytest.mark.parametrize("width", [1, 2, 5, 17])
def test_points_of_other_widths_have_radii_too(width: int):
    points = torch.rand(300, width, generator=torch.Generator().manual_seed(width)).round(decimals=1)
    ptr = torch.tensor([0, 0, 120, 121, 300])
    assert_equal(F.radius_neighbors, points, ptr, radius=radii(300, 0.6), exclude_self=True)
    assert_equal(F.ball_query, points, ptr, radius=radii(300, 0.6), max_neighbors=5)


@pytest.mark.parametrize("threads", [2, 5])
def test_any_number_of_threads_lists_the_same(threads: int):
    before = torch.get_num_threads()
    points = torch.cat([random_cloud(9000, spread=0.2), torch.zeros(300, 3)])
    found = []
    try:
        for number in (1, threads):
            torch.set_num_threads(number)
            found.append(F.radius_neighbors(points, radius=0.03))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))
    assert int(found[0][2][-1]) > 300 * 300


def test_distances_of_any_spread_are_in_order():
    """The nearest of a query at distances from 1e-18 to 1, hundreds of them equal: buckets of distances overflow."""
    away = torch.cat([10.0 ** -torch.arange(0, 18, 0.05), torch.full((200,), 0.5), torch.full((90,), 0.99)])
    points = away[torch.randperm(len(away), generator=torch.Generator().manual_seed(1)), None] * torch.eye(3)[:1]
    assert_equal(F.radius_neighbors, points, queries=torch.zeros(1, 3), radius=2.0)
    assert_equal(F.radius_neighbors, points.T.contiguous().T, queries=torch.zeros(1, 3), radius=0.7)
