"""Many small clouds in one call: each as if it were alone, and in little more time than one large cloud."""

from __future__ import annotations

import itertools
import time
from typing import Any

import pytest
import torch

from pcdata.contracts.dispatch import why_unavailable
from pcdata.functional.planes import ransac_plane
from pcdata.functional.rows import ptr_from_counts
from pcdata.functional.voxels import find_voxel_size
from tests.kernels.cpu.clouds import random

REASON = why_unavailable("cpu")
pytestmark = pytest.mark.skipif(REASON is not None, reason=str(REASON))


@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_a_batch_of_many_small_clouds_is_each_cloud_alone(backend):
    """More clouds than are looked at one by one, of different sizes, and more hypotheses than are drawn at a time."""
    counts = [3 + cloud % 29 for cloud in range(150)]
    ptr, points = ptr_from_counts(counts), random(sum(counts), 3, seed=3)
    arguments = {"distance": 0.2, "num_hypotheses": 40, "backend": backend}
    planes, inliers = ransac_plane(points, ptr, **arguments)
    sizes = find_voxel_size(points, ptr, num_points=3, backend=backend)
    bounds = ptr.tolist()
    for cloud, (start, stop) in enumerate(itertools.pairwise(bounds)):
        plane, mask = ransac_plane(points[start:stop], **arguments)
        assert torch.equal(plane, planes[cloud : cloud + 1])
        assert torch.equal(mask, inliers[start:stop])
        alone = find_voxel_size(points[start:stop], num_points=3, backend=backend)
        assert torch.equal(alone, sizes[cloud : cloud + 1])


@pytest.mark.parametrize("operation", [ransac_plane, find_voxel_size])
def test_ten_thousand_small_clouds_take_a_small_multiple_of_one_large_one(operation):
    """A look at each cloud from Python took 300 times as long; 10 million planes to make are what is left."""
    points, ptr = random(200_000, 3), torch.arange(10_001) * 20
    options = {ransac_plane: {"distance": 0.05}, find_voxel_size: {"num_points": 7}}[operation]

    def seconds(*args: Any) -> float:
        start = time.process_time()
        operation(*args, **options)
        return time.process_time() - start

    seconds(points)
    assert min(seconds(points, ptr) for _ in range(3)) < 12 * max(seconds(points), 0.05)
