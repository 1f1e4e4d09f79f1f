from __future__ import annotations

import pytest
import torch

from pcdata.errors import ConfigError
from pcdata.structures import PointCloud
from pcdata.transforms import RemoveRadiusOutliers, RemoveStatisticalOutliers

GRID = torch.cartesian_prod(torch.arange(12) * 0.01, torch.arange(12) * 0.01, torch.zeros(1))
STRAYS = torch.tensor([[0.0, 0.0, 0.5], [0.3, 0.3, 0.3]])


def patch_with_strays() -> PointCloud:
    return PointCloud(points=torch.cat([STRAYS[:1], GRID, STRAYS[1:]]), frame_id="base")


@pytest.mark.parametrize(
    "step", [RemoveStatisticalOutliers(num_neighbors=6), RemoveRadiusOutliers(min_neighbors=3, radius=0.015)]
)
def test_points_far_from_a_regular_patch_are_dropped_and_the_patch_stays(step):
    assert torch.equal(step(patch_with_strays()).points, GRID)


@pytest.mark.parametrize(
    "step", [RemoveStatisticalOutliers(num_neighbors=6), RemoveRadiusOutliers(min_neighbors=3, radius=0.015)]
)
def test_the_neighbors_of_another_cloud_do_not_count(step):
    alone = PointCloud(points=torch.cat([GRID, STRAYS[:1]]), frame_id="base")
    around_the_stray = PointCloud(points=torch.cat([GRID + STRAYS[0], GRID[:1] - 1.0]), frame_id="base")
    both = step(PointCloud.cat([alone, around_the_stray]))
    assert both.counts.tolist() == [144, 144]


def test_the_radius_rule_counts_the_point_itself_and_is_strict():
    line = PointCloud(points=torch.tensor([[0.0, 0, 0], [0.5, 0, 0], [1.0, 0, 0]]), frame_id="base")
    # With itself, the middle has 3 points within 0.6 and the ends have 2: more than min_neighbors stay.
    assert RemoveRadiusOutliers(min_neighbors=2, radius=0.6)(line).points[:, 0].tolist() == [0.5]


def test_fields_out_of_range_are_refused():
    for fields in ({"num_neighbors": 0}, {"std_ratio": 0.0}, {"num_neighbors": 2.5}, {"std_ratio": float("nan")}):
        with pytest.raises(ConfigError, match=f"RemoveStatisticalOutliers.{next(iter(fields))}"):
            RemoveStatisticalOutliers(**fields)
