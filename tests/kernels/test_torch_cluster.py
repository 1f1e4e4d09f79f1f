from __future__ import annotations

import builtins
import re

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pcdata.contracts.dispatch import why_unavailable
from pcdata.errors import BackendError, TooFewPointsError
from pcdata.functional.neighbors import ball_query
from pcdata.functional.rows import ptr_from_counts
from pcdata.functional.sampling import farthest_point_sample
from pcdata.kernels import torch_cluster as backend

REASON = why_unavailable("torch_cluster")
needs_torch_cluster = pytest.mark.skipif(REASON is not None, reason=str(REASON))

ragged_counts = st.lists(st.integers(0, 25), min_size=1, max_size=4)
few = settings(max_examples=25, deadline=None)


def cloud(count: int, seed: int = 0) -> torch.Tensor:
    return torch.randn((count, 3), generator=torch.Generator().manual_seed(seed))


@needs_torch_cluster
@few
@given(ragged_counts, st.integers(0, 99), st.sampled_from([1e-3, 1.0, 1e4]))
def test_samples_equal_the_reference(counts, seed, scale):
    points, ptr = cloud(sum(counts), seed) * scale, ptr_from_counts(counts)
    wanted = [count - seed % 3 if count > 3 else count for count in counts]
    ours = farthest_point_sample(points, ptr, num_samples=wanted)
    theirs = farthest_point_sample(points, ptr, num_samples=wanted, backend="torch_cluster")
    assert torch.equal(ours[0], theirs[0])
    assert torch.equal(ours[1], theirs[1])


@needs_torch_cluster
@pytest.mark.parametrize("count", [1, 2, 333, 4999, 5000])
def test_every_count_can_be_had_from_a_ratio(count):
    points = cloud(5000)
    theirs, _ = farthest_point_sample(points, num_samples=count, backend="torch_cluster")
    assert torch.equal(theirs, farthest_point_sample(points, num_samples=count)[0])


@needs_torch_cluster
def test_ties_on_a_lattice_go_to_the_lowest_row_too():
    axis = torch.arange(6.0)
    points = torch.cartesian_prod(axis, axis, axis)
    theirs, _ = farthest_point_sample(points, num_samples=100, backend="torch_cluster")
    assert torch.equal(theirs, farthest_point_sample(points, num_samples=100)[0])


@needs_torch_cluster
def test_repeated_picks_are_refused():
    with pytest.raises(BackendError, match=r"3 distinct points of 4 for cloud 0.*backend='auto'"):
        farthest_point_sample(cloud(3).repeat(2, 1), num_samples=4, backend="torch_cluster")


@needs_torch_cluster
def test_too_few_points_are_refused_as_by_the_reference():
    with pytest.raises(TooFewPointsError, match="cloud 0, which has 3"):
        farthest_point_sample(cloud(3), num_samples=4, backend="torch_cluster")


@needs_torch_cluster
@few
@given(ragged_counts, st.integers(0, 99), st.floats(0.1, 3.0), st.integers(1, 8))
def test_neighbors_equal_the_reference(counts, seed, radius, max_neighbors):
    points, ptr = cloud(sum(counts), seed), ptr_from_counts(counts)
    arguments = {"radius": radius, "max_neighbors": max_neighbors}
    for ours, theirs in zip(
        ball_query(points, ptr, **arguments), ball_query(points, ptr, **arguments, backend="torch_cluster")
    ):
        assert torch.equal(ours, theirs)


@needs_torch_cluster
def test_neighbors_of_other_queries_equal_the_reference_with_ties_on_the_radius():
    axis = torch.arange(5.0)
    points = torch.cartesian_prod(axis, axis, axis)
    queries = torch.cat([points[::7], cloud(20) + 2])
    arguments = {"radius": 1.0, "max_neighbors": 5, "queries": queries}
    for ours, theirs in zip(ball_query(points, **arguments), ball_query(points, **arguments, backend="torch_cluster")):
        assert torch.equal(ours, theirs)


def test_cuda_is_refused_because_ties_break_the_contract():
    with pytest.raises(BackendError, match="on the CPU only, the points are on meta"):
        backend._require_cpu("farthest_point_sample", torch.zeros(1, 3, device="meta"))


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (ImportError("No module named 'torch_cluster'"), "not installed.*pip install ninja && .*--no-build-isolation"),
        (OSError("undefined symbol: _ZN3c10"), "undefined symbol.*rebuild it with: pip install"),
    ],
)
def test_an_absent_or_broken_build_gives_the_command(monkeypatch, error, message):
    real_import = builtins.__import__

    def failing_import(name, *args, **kwargs):
        if name == "torch_cluster":
            raise error
        return real_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", failing_import)
    reason = backend.unavailable()
    assert reason is not None
    assert re.search(message, reason)
