"""VoxelSample, RandomVoxelSample, RandomColumn, ShiftToOrigin and sampling with replacement."""

from __future__ import annotations

import pytest
import torch

from pcdata.errors import TooFewPointsError
from pcdata.rng import seeded
from pcdata.structures import PointCloud
from pcdata.transforms import RandomColumn, RandomSample, RandomVoxelSample, ShiftToOrigin, VoxelSample
from tests.factories import cloud_in_base


def line(*x: float) -> PointCloud:
    return PointCloud(points=torch.tensor([[value, 0.0, 0.0] for value in x]), frame_id="base")


def test_the_first_point_of_every_voxel_stays_and_cells_are_floored():
    kept = VoxelSample(voxel_size=1.0)(line(0.9, 0.1, -0.1, 1.0, -0.9, 1.5))
    assert kept.points[:, 0].tolist() == pytest.approx([0.9, -0.1, 1.0])


def test_a_grid_too_large_to_number_gives_the_same_points():
    far = line(0.9, 0.1, -0.1, 1e12)
    far = PointCloud(points=far.points + torch.tensor([[0.0, 0.0, 0.0]] * 3 + [[0.0, 1e12, 1e12]]), frame_id="base")
    assert VoxelSample(voxel_size=1.0)(far).num_points == 3


def test_every_point_of_a_voxel_may_be_the_random_one():
    step = RandomVoxelSample(voxel_size=1.0)
    seen = {round(float(step(line(0.1, 0.5, 0.9), generator=seeded(seed)).points[0, 0]), 1) for seed in range(40)}
    assert seen == {0.1, 0.5, 0.9}


def test_drawing_with_replacement_repeats_points_even_of_a_full_cloud():
    cloud = cloud_in_base((400,))
    drawn = RandomSample(num_points=300, with_replacement=True)(cloud, generator=seeded(0))
    distinct = len(torch.unique(drawn.extra["row"]))
    assert drawn.num_points == 300
    assert distinct == pytest.approx(400 * (1 - (1 - 1 / 400) ** 300), abs=25)
    assert RandomSample(num_points=900, with_replacement=True)(cloud, generator=seeded(0)).num_points == 900


def test_zero_rows_fill_up_what_is_short_also_with_replacement():
    step = RandomSample(num_points=60, with_replacement=True, if_short="zeros")
    filled = step(cloud_in_base((50,)), generator=seeded(0))
    assert int((filled.points == 0).all(dim=1).sum()) == 10
    assert len(torch.unique(filled.points, dim=0)) == 51


def test_a_column_holds_all_heights_about_its_center():
    cloud = cloud_in_base((300,))
    column = RandomColumn(size=0.1, min_points=3)(cloud, generator=seeded(2))
    center = torch.tensor(column.meta[0]["column_center"])
    inside = ((cloud.points - center)[:, :2].abs() <= 0.05).all(dim=1)
    assert torch.equal(column.points, cloud.points[inside])


def test_a_scene_too_sparse_for_a_column_ends_with_an_error_and_not_never():
    with pytest.raises(TooFewPointsError, match=r"of 100 columns .* none has 1025 points, the fullest has"):
        RandomColumn()(cloud_in_base((300,)), generator=seeded(0))


@pytest.mark.parametrize(("anchor", "wanted"), [("corner", [0.0, 0.0, 0.0]), ("floor", [-0.5, -1.0, 0.0])])
def test_the_origin_moves_to_the_corner_or_the_middle_of_the_floor(anchor, wanted):
    cloud = PointCloud(points=torch.tensor([[1.0, 2.0, 3.0], [2.0, 4.0, 6.0]]), frame_id="base")
    moved = ShiftToOrigin(anchor=anchor)(cloud)
    assert moved.points[0].tolist() == wanted
    assert moved.meta[0]["extent"] == [1.0, 2.0, 3.0]
    assert moved.frame_id == f"base/{anchor}"
    assert torch.equal(moved.in_source_frame().points, cloud.points)
