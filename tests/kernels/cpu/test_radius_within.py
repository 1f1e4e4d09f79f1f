"""Radius outliers among some of the points, as they lie: what the others would be if they were gone."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pcdata.contracts.dispatch import INNER, why_unavailable
from pcdata.errors import ConfigError
from pcdata.functional.rows import ptr_from_counts
from pcdata.rng import seeded
from pcdata.structures import PointCloud
from pcdata.synthetic import tabletop
from pcdata.transforms import Deproject

REASON = why_unavailable("cpu")
pytestmark = pytest.mark.skipif(REASON is not None, reason=str(REASON))

SHARES = [0.0, 0.02, 0.5, 0.97, 1.0]


def both(points: Tensor, ptr: Tensor, within: Tensor, *arguments: object) -> None:
    given = points, ptr, *arguments, within
    for found, expected in zip(OPERATION.kernels["cpu"](*given), OPERATION.reference(*given), strict=True):
        assert torch.equal(found, expected)


OPERATION = INNER["rows_in_company"]


@pytest.fixture(scope="module")
def views() -> PointCloud:
    return Deproject()(tabletop(2, num_objects=3, num_views=2, size=(120, 160)).frame)


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize(("radius", "enough"), [(0.004, 1), (0.01, 5), (0.05, 20), (0.05, 400), (0.01, 10**12)])
def test_on_depth_images(views, radius, enough, share):
    within = torch.rand(views.num_points, generator=seeded(1)) < share
    for grid in (views.image_grid(), None):
        both(views.points, views.ptr, within, enough, radius, grid)


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("count", [3, 100, 20_000])
def test_of_points_in_no_order(count, share):
    points, ptr = torch.rand(count, 3, generator=seeded(2)), ptr_from_counts([count // 3, 0, count - count // 3])
    within = torch.rand(count, generator=seeded(3)) < share
    for radius, enough in ((0.02, 3), (0.05, 10), (0.2, 5), (0.005, 1)):
        both(points, ptr, within, enough, radius, None)


def test_what_is_far_out_counts_where_it_is_a_point():
    points, within = torch.rand(20_000, 3, generator=seeded(2)), torch.ones(20_000, dtype=torch.bool)
    points[5] = 1e30
    with pytest.raises(ConfigError, match="stray point far out"):
        OPERATION.kernels["cpu"](points, ptr_from_counts([20_000]), 3, 0.02, None, within)
    within[5] = False
    both(points, ptr_from_counts([20_000]), within, 3, 0.02, None)
    both(points[5:6], ptr_from_counts([1]), within[5:6], 3, 0.02, None)
