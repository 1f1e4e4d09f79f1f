"""Neighbors by other norms than the straight one, against SciPy and looking at every pair."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from pcdata import functional as F
from pcdata.contracts.dispatch import why_unavailable
from pcdata.errors import BackendError, ConfigError
from pcdata.functional.norms import nearest_by_norm
from pcdata.functional.rows import ptr_from_counts
from pcdata.rng import seeded

NORMS = pytest.mark.parametrize(("norm", "power"), [("l1", 1), ("linf", np.inf)])
BACKENDS = ["torch", *(name for name in ("cpu", "torch_tree") if why_unavailable(name) is None)]


def cloud(count: int, seed: int, columns: int = 3) -> torch.Tensor:
    """Coordinates on a grid of 1/64, so that distances are exact and many are equal."""
    return torch.randint(0, 64, (count, columns), generator=seeded(seed)).float() / 64


@NORMS
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("columns", [1, 2, 3, 4, 6])
def test_the_nearest_are_scipys(norm, power, backend, columns):
    points, queries = cloud(300, 0, columns), cloud(90, 1, columns)
    index, distance = F.knn(points, queries=queries, k=7, norm=norm, backend=backend)
    expected, _ = cKDTree(points.numpy()).query(queries.numpy(), k=7, p=power)
    np.testing.assert_array_equal(distance.numpy(), expected.astype(np.float32))
    apart = (queries[:, None] - points[index]).abs()
    assert torch.equal(apart.sum(-1) if norm == "l1" else apart.amax(-1), distance)
    ties = distance.diff(dim=1) == 0
    assert bool((index.diff(dim=1) > 0)[ties].all()), "ties go to the lowest row"


@NORMS
@pytest.mark.parametrize("backend", BACKENDS)
@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(0, 40), min_size=1, max_size=4), st.integers(1, 12), st.booleans(), st.integers(0, 99))
def test_ragged_batches_are_as_all_pairs_say(norm, power, backend, counts, k, per_query, seed):
    ptr, queries_ptr = ptr_from_counts(counts), ptr_from_counts([count // 2 + 1 for count in counts])
    points, queries = cloud(sum(counts), seed), cloud(int(queries_ptr[-1]), seed + 1)
    radius = 0.1 + 0.3 * torch.rand(len(queries), generator=seeded(seed)) if per_query else 0.25
    apart = (queries[:, None].double() - points.double()).abs()
    apart = apart.sum(-1) if norm == "l1" else apart.amax(-1)
    limit = torch.as_tensor(radius, dtype=torch.float32).expand(len(queries))
    own = F.cloud_of_rows(queries_ptr)[:, None] == F.cloud_of_rows(ptr)
    apart = torch.where(own & (apart.float() < limit[:, None]), apart, torch.inf)
    order = apart.sort(dim=1, stable=True)
    asked = {"queries": queries, "queries_ptr": queries_ptr, "norm": norm, "backend": backend}
    index, distance, count = F.ball_query(points, ptr, radius=radius, max_neighbors=k, **asked)
    wanted = order.values[:, :k].float()
    assert torch.equal(distance[:, : wanted.shape[1]], wanted)
    assert torch.equal(index[distance < torch.inf], order.indices[:, :k][wanted < torch.inf])
    assert torch.equal(count, (wanted < torch.inf).sum(1))
    listed, lengths, found_ptr = F.radius_neighbors(points, ptr, radius=radius, **asked)
    assert torch.equal(lengths, order.values[order.values < torch.inf].float())
    assert torch.equal(listed, order.indices[order.values < torch.inf])
    assert torch.equal(found_ptr.diff(), (order.values < torch.inf).sum(1))


@NORMS
def test_a_point_is_not_its_own_neighbor_and_distances_have_a_gradient(norm, power):
    points = torch.rand(50, 3, generator=seeded(3), requires_grad=True)
    index, distance = F.knn(points, k=4, norm=norm, exclude_self=True)
    assert not bool((index == torch.arange(50)[:, None]).any())
    offset = points[:, None] - points[index]
    wanted = offset.abs().sum(-1) if norm == "l1" else offset.abs().amax(-1)
    found, expected = (torch.autograd.grad(value.sum(), points, retain_graph=True)[0] for value in (distance, wanted))
    torch.testing.assert_close(found, expected)


@NORMS
def test_far_and_tiny_clouds_are_exact(norm, power):
    for scale in (1e-12, 1.0, 1e12):
        points = torch.rand(200, 3, generator=seeded(4)) * scale
        for backend in BACKENDS:
            one, other = (F.knn(points, k=5, norm=norm, backend=name) for name in ("torch", backend))
            assert torch.equal(one[0], other[0])
            assert torch.equal(one[1], other[1])
    same = torch.full((30, 3), 0.7)
    assert F.knn(same, k=4, norm=norm)[0].tolist() == [[0, 1, 2, 3]] * 30


def test_unknown_norms_are_refused():
    points = torch.rand(5, 3)
    with pytest.raises(ConfigError, match="knn: norm must be one of 'l2', 'l1', 'linf'"):
        F.knn(points, k=1, norm="l3")
    if why_unavailable("torch_cluster") is None:
        with pytest.raises(BackendError, match="norm"):
            F.ball_query(points, radius=0.1, max_neighbors=2, norm="l1", backend="torch_cluster")


@pytest.mark.skipif(why_unavailable("cpu") is not None, reason="the compiled core is not there")
@pytest.mark.parametrize("width", [1, 2, 3, 5, 9, 17])
@pytest.mark.parametrize("norm", ["l1", "linf"])
def test_the_trees_give_the_bits_of_looking_at_every_pair(norm, width):
    """Ties, repeats, zeros of both signs, empty clouds, more neighbors than points, limits of each query."""
    generator = torch.Generator().manual_seed(width)
    points = torch.randint(-3, 4, (400, width), generator=generator).float() * 0.25
    points = torch.where(torch.rand(points.shape, generator=generator) < 0.2, -0.0, points)
    points[200:] += 1e-3 * torch.randn(200, width, generator=generator)
    queries = points[torch.randperm(400, generator=generator)[:90]] + 0.125
    ptr, queries_ptr = torch.tensor([0, 150, 150, 155, 400]), torch.tensor([0, 30, 40, 60, 90])
    limit = torch.rand(90, generator=generator) * width
    limit[::3] = torch.inf
    for k in (1, 7, 40):
        asked = points, ptr, norm, k, queries, queries_ptr, limit
        index, distance = nearest_by_norm(*asked, backend="cpu")
        wanted, apart = nearest_by_norm(*asked, backend="torch")
        assert torch.equal(index, wanted)
        assert torch.equal(distance.view(torch.int32), apart.view(torch.int32))
