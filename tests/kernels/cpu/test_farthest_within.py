"""Farthest points among some of the points, as they lie: what the sampler picks if the others are gone."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pcdata.contracts.dispatch import INNER, why_unavailable
from pcdata.functional.rows import ptr_after_mask, ptr_from_counts
from pcdata.kernels.cpu import native
from pcdata.rng import seeded
from pcdata.synthetic import tabletop
from pcdata.transforms import Deproject

REASON = why_unavailable("cpu")
pytestmark = pytest.mark.skipif(REASON is not None, reason=str(REASON))

OPERATION = INNER["farthest_rows_within"]


def both(points: torch.Tensor, ptr: torch.Tensor, within: torch.Tensor, most: int) -> None:
    kept = ptr_after_mask(within, ptr)
    counts = [min(most, have) for have in kept.diff().tolist()]
    arguments = points, kept, within, counts
    for found, expected in zip(OPERATION.kernels["cpu"](*arguments), OPERATION.reference(*arguments), strict=True):
        assert torch.equal(found, expected)
        assert len(found) == sum(counts)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.97, 1.0])
@pytest.mark.parametrize("count", [1, 63, 65, 8193, 30_000])
def test_of_several_clouds_and_of_one(count, share):
    points = torch.rand(count, 3, generator=seeded(2))
    within = torch.rand(count, generator=seeded(3)) < share
    for sizes in ([count], [count // 3, 0, count - count // 3]):
        both(points, ptr_from_counts(sizes), within, 100)


def test_on_a_depth_image_whose_plane_is_gone():
    cloud = Deproject()(tabletop(2, num_objects=3, num_views=2, size=(120, 160)).frame)
    both(cloud.points, cloud.ptr, cloud.points[:, 2] < cloud.points[:, 2].median(), 256)


def test_of_equal_points_the_lowest_row_comes_first():
    points = torch.randint(0, 3, (5000, 3), generator=seeded(4)).float()
    both(points, ptr_from_counts([2000, 3000]), torch.rand(5000, generator=seeded(5)) < 0.5, 200)


def test_a_mask_may_hold_other_bytes_and_be_every_other_one():
    points, ptr = torch.rand(9000, 3, generator=seeded(6)), ptr_from_counts([9000])
    some = torch.rand(9000, generator=seeded(7)) < 0.4
    expected = OPERATION.reference(points, ptr_after_mask(some, ptr), some, [64])
    bytes_of = torch.from_numpy(np.where(some.numpy(), 7, 0).astype(np.uint8).view(np.bool_))
    strided = torch.stack([some, ~some], 1)[:, 0]
    for within in (bytes_of, strided):
        found = OPERATION.kernels["cpu"](points, ptr_after_mask(some, ptr), within, [64])
        assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))


def test_a_mask_of_other_rows_than_is_said_is_refused():
    points, rows = torch.rand(50, 3), torch.empty(2, dtype=torch.int64)
    ptr, wanted = torch.tensor([0, 40]), torch.tensor([2])
    with pytest.raises(RuntimeError, match="failed with status"):
        native.call(
            *("pc_farthest_points", points, ptr, 1, torch.ones(50, dtype=torch.bool), 50),
            *(wanted, torch.empty_like(rows), rows),
        )
