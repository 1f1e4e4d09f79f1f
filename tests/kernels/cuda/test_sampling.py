"""Farthest points on a GPU: a block a cloud, all blocks for one; ties, repeats, any number of columns."""

from __future__ import annotations

import pytest
import torch

from pcdata import functional as F
from pcdata.kernels.cuda import sampling
from pcdata.rng import seeded
from tests import pretend_device
from tests.kernels.cuda import harness

pytestmark = pytest.mark.skipif(harness.unavailable() is not None, reason=str(harness.unavailable()))
harness.register()


@pytest.fixture(params=["a block a cloud", "three blocks", "many blocks"])
def way(request, monkeypatch):
    if request.param == "a block a cloud":
        return {3: "pc_sample_clouds"}
    monkeypatch.setattr(sampling, "_LARGE", 0)
    monkeypatch.setattr(sampling, "_MOST_THREADS", 64)  # fewer fibers
    monkeypatch.setattr(sampling, "_BLOCK", 32)
    monkeypatch.setattr(sampling, "_TILE", 10)
    if request.param == "many blocks":
        monkeypatch.setattr(harness.Harness, "resident_blocks", lambda self, name, block: 23)
    return {3: "pc_sample_in_passes", None: "pc_sample_cloud"}


def agree(points, ptr, **options) -> None:
    found = F.farthest_point_sample(points, ptr, **options, backend=harness.BACKEND)
    expected = F.farthest_point_sample(points, ptr, **options, backend="torch")
    assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))


@pytest.mark.parametrize("columns", [1, 2, 3, 6])
def test_clouds_of_any_size(columns, way, ordered):
    points = torch.rand(430, columns, generator=seeded(1))
    points[100:130] = points[130:160]
    agree(points, torch.tensor([0, 1, 1, 300, 430]), num_samples=[1, 0, 40, 130])
    assert way.get(columns, way.get(None, way[3])) in ordered.started


def test_equal_points_and_points_of_a_lattice_go_by_their_rows(way, ordered):
    agree(torch.ones(80, 3), None, num_samples=80)
    steps = torch.arange(5.0)
    agree(torch.cartesian_prod(steps, steps, steps), None, num_samples=125)


def test_huge_and_tiny_distances(way, ordered):
    agree(torch.rand(90, 3, generator=seeded(2)) * 1e19, None, num_samples=30)
    agree(torch.rand(90, 3, generator=seeded(2)) * 1e-22, None, num_samples=30)


@pytest.mark.skipif(not pretend_device.AVAILABLE, reason="this PyTorch has no devices written in Python")
def test_sampling_never_waits_for_the_device(monkeypatch):
    device = harness.as_on_a_gpu(monkeypatch)
    points, ptr = torch.rand(300, 3, generator=seeded(2)).to(device), torch.tensor([0, 100, 300]).to(device)
    with pretend_device.watching() as watched:
        F.farthest_point_sample(points, ptr, num_samples=10)
    assert [place for place in watched.waits if "kernels/cuda" in place] == []


def test_several_picks_are_drawn_between_two_meetings(monkeypatch):
    monkeypatch.setattr(sampling, "_LARGE", 0)
    monkeypatch.setattr(sampling, "_BLOCK", 32)
    monkeypatch.setattr(sampling, "_TILE", 10)
    monkeypatch.setattr(harness.Harness, "resident_blocks", lambda self, name, block: 64)
    arrived = []
    start = harness.Harness.launch_blocks

    def watched(self, name, blocks, *arguments, **options):
        start(self, name, blocks, *arguments, **options)
        if name == "pc_sample_in_passes":
            arrived.append(int(arguments[-2]) // blocks)

    monkeypatch.setattr(harness.Harness, "launch_blocks", watched)
    points = torch.rand(1500, 3, generator=seeded(4)) * torch.tensor([1.0, 1.0, 0.05])
    agree(points, None, num_samples=200)
    assert arrived[0] < 200 / 3, f"{arrived[0]} meetings for 200 picks"


def test_room_behind_a_large_cloud_and_clouds_that_have_too_few(way, ordered):
    points = torch.rand(90, 3, generator=seeded(5))
    roomy, ptr = torch.cat([points, torch.full((60, 3), 7.0)]), torch.tensor([0, 50, 50, 90])
    picks = sampling.farthest_rows(roomy, ptr, [20, 3, 45])
    expected, _ = F.farthest_point_sample(points[:50], num_samples=20, backend="torch")
    assert torch.equal(picks[:20], expected)
    assert sorted(picks[23:63].tolist()) == list(range(50, 90))
    assert picks.min() >= 0
    assert picks.max() < 90
