"""Medians and connected parts of depth images, at any number of threads."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pcdata.contracts.dispatch import INNER, why_unavailable
from pcdata.functional.image_clusters import linked_pixels
from pcdata.functional.image_grid import ImageGrid
from pcdata.functional.rows import ptr_from_counts
from pcdata.functional.table_surface import window_medians
from pcdata.rng import seeded

pytestmark = pytest.mark.skipif(why_unavailable("cpu") is not None, reason=str(why_unavailable("cpu")))


def batch(height: int, width: int, *shares: float) -> tuple[Tensor, Tensor, ImageGrid]:
    """Clouds on images of one size, each with a share of the pixels: points, ptr, grid."""
    generator = seeded(height * width)
    kept = [(torch.rand(height * width, generator=generator) < share).nonzero().squeeze(1) for share in shares]
    pixel = torch.cat(kept)
    depth = torch.randint(1, 4, (len(pixel),), generator=generator) * 0.5
    points = torch.stack([0.01 * (pixel % width), 0.01 * (pixel // width), depth], 1)
    intrinsics = torch.eye(3).expand(len(shares), 3, 3)
    return points, ptr_from_counts([len(one) for one in kept]), ImageGrid(pixel, (height, width), intrinsics)


SIZES = [(1, 1), (1, 70), (70, 1), (3, 129), (150, 201)]


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("size", SIZES)
def test_windows_equal_the_reference(size, threads, monkeypatch):
    points, ptr, grid = batch(*size, 0.9, 0.0, 1.0, 0.3)
    values = torch.randn(len(points), generator=seeded(1))
    values[::50] = torch.nan
    monkeypatch.setattr("pcdata.kernels.cpu.native.core_threads", lambda: threads)
    own, expected = (window_medians(values, points, ptr, grid, backend=backend) for backend in ("cpu", "torch"))
    assert torch.equal(own.isnan(), expected.isnan())
    assert torch.equal(own.nan_to_num(), expected.nan_to_num())
    for reach in (1, 2, 3):
        given = points, ptr, grid.pixel_index, size, 0.015 * reach, reach
        assert torch.equal(*(linked_pixels(*given, backend=backend) for backend in ("cpu", "torch")))


def test_medians_of_doubles_and_without_a_grid_are_those_of_the_reference():
    points, ptr, grid = batch(9, 14, 0.8)
    for values, on in ((points[:, 2].double(), grid), (points[:, 2].contiguous(), None)):
        found = INNER["window_medians"].kernels["cpu"](values, points, ptr, on)
        assert torch.equal(found, INNER["window_medians"].reference(values, points, ptr, on))
