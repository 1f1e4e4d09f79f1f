"""Voxels on a GPU: the reference's bits, whichever point comes first to its voxel."""

from __future__ import annotations

import pytest
import torch

from pcdata import functional as F
from pcdata.errors import UnitError
from pcdata.rng import seeded
from tests import pretend_device
from tests.kernels.cuda import harness

pytestmark = pytest.mark.skipif(harness.unavailable() is not None, reason=str(harness.unavailable()))
harness.register()


def agree(points, ptr=None, **options) -> None:
    found = F.voxel_downsample(points, ptr, **options, backend=harness.BACKEND)
    expected = F.voxel_downsample(points, ptr, **options, backend="torch")
    for one, other in zip(found, expected, strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("size", [1e-6, 0.02, 0.3, 10.0])
def test_clouds_at_random(size, ordered):
    points = torch.randn(1500, 3, generator=seeded(0))
    points[3::5] = points[2::5]
    ptr = torch.tensor([0, 0, 1100, 1101, 1500])
    agree(points, ptr, voxel_size=size)
    agree(points, ptr, voxel_size=size, origin=[0.1, -0.2, 0.3], min_points=2)
    agree(points, ptr, voxel_size=torch.tensor([[size, 2 * size, 0.5]] * 4))


def test_one_size_per_cloud_and_clouds_far_apart(ordered):
    points = torch.rand(2600, 3, generator=seeded(1)) + torch.tensor([1e4, -1e4, 0])
    agree(points, torch.tensor([0, 1300, 2600]), voxel_size=[0.1, 0.25])
    agree(-points, None, voxel_size=0.1)


def test_points_on_the_faces_of_voxels(ordered):
    steps = torch.arange(-6, 7) * 0.25
    agree(torch.cartesian_prod(steps, steps, steps), voxel_size=0.5)
    agree(torch.cartesian_prod(steps, steps, steps), voxel_size=0.5, origin=[0.0, 0.0, 0.0])


def test_an_extent_beyond_all_voxels_is_refused_as_by_the_reference():
    points = torch.tensor([[0.0, 0, 0], [1e12, 0, 0]])
    with pytest.raises(UnitError, match="voxel_downsample: cloud 0 spans"):
        F.voxel_downsample(points, voxel_size=1e-6, backend=harness.BACKEND)


def test_nothing_is_nothing():
    agree(torch.zeros(0, 3), torch.tensor([0, 0, 0]), voxel_size=0.1)


@pytest.mark.skipif(not pretend_device.AVAILABLE, reason="this PyTorch has no devices written in Python")
def test_one_wait_for_the_number_of_voxels(monkeypatch):
    device = harness.as_on_a_gpu(monkeypatch)
    points, ptr = torch.rand(500, 3, generator=seeded(2)).to(device), torch.tensor([0, 200, 500]).to(device)
    with pretend_device.watching() as watched:
        F.voxel_downsample(points, ptr, voxel_size=0.1)
    assert [count for place, count in watched.waits.items() if "kernels/cuda" in place] == [1]
