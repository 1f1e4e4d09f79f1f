"""Which planes a cloud has, and which of them is the table."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from pcdata.errors import ConfigError, NoPlaneError, UnitError
from pcdata.functional import ransac_plane, segment_planes, supporting_plane, voxel_downsample
from pcdata.functional.plane_slices import without_slices
from pcdata.rng import seeded
from tests.tables import TABLE, WALL, box, rectangle, seen_from_camera

UP = (0.0, 0.0, 1.0)


def joined(*parts: Tensor) -> Tensor:
    return torch.cat(parts)


def height_of(plane: Tensor) -> float:
    """Where a plane crosses the z axis."""
    return -float(plane[3] / plane[2])


def test_planes_are_found_one_after_another_and_every_point_says_whose_it_is():
    table, wall = rectangle(**TABLE, seed=0), rectangle(**WALL, seed=1)
    cloud = joined(table, wall, torch.rand(500, 3, generator=seeded(2)) * 0.3 + torch.tensor([0.0, 0.0, 0.1]))
    planes, ptr, label = segment_planes(cloud, distance=0.005, min_share=0.1)
    assert ptr.tolist() == [0, 2]
    first = 0 if len(table) >= len(wall) else 1
    assert float((label[: len(table)] == first).float().mean()) > 0.98
    assert float((label[len(table) : -500] == 1 - first).float().mean()) > 0.98
    expected, near = ransac_plane(cloud, distance=0.005)
    assert torch.equal(planes[0], expected[0])
    assert torch.equal(label == 0, near)


@pytest.mark.parametrize("count", [0, 2, 40])
def test_a_cloud_without_planes_has_none(count):
    planes, ptr, label = segment_planes(torch.rand(count, 3, generator=seeded(0)), distance=0.001, min_share=0.3)
    assert planes.shape == (0, 4)
    assert ptr.tolist() == [0, 0]
    assert bool((label == -1).all())
    if count > 3:
        with pytest.raises(NoPlaneError, match=r"cloud 0: no plane holds 0\.3 of its 40 voxels"):
            supporting_plane(torch.rand(count, 3, generator=seeded(0)), distance=0.001, min_share=0.3)


def test_a_wall_larger_than_the_table_is_not_the_table():
    things = [box((x, y, 0.0), (0.08, 0.06, 0.12), seed=9) for x, y in ((0.1, 0.1), (-0.2, 0.2), (0.25, -0.2))]
    cloud = joined(rectangle(**WALL, seed=1), rectangle(**TABLE, seed=0), *things)
    largest, _ = ransac_plane(cloud)
    assert abs(float(largest[0, 2])) < 0.1
    plane, near = supporting_plane(cloud, viewpoint=(-1.0, 0.0, 1.0))  # up is not known
    assert float(plane[0, 2]) > 0.999
    assert abs(height_of(plane[0])) < 0.002
    assert bool(near[len(cloud) - sum(map(len, things)) - 3000 : -sum(map(len, things))].all())


def test_the_top_of_a_box_that_is_seen_best_is_not_the_table():
    """A box near the sensor has most of the points, and a smaller one on it."""
    near_box, small = box((0.0, 0.0, 0.0), (0.3, 0.25, 0.3), seed=3, count=40_000), box((0, 0, 0.3), (0.05, 0.05, 0.05))
    others = [box((x, y, 0.0), (0.1, 0.1, 0.1), seed=4) for x, y in ((0.35, 0.3), (-0.35, -0.3), (0.35, -0.3))]
    table = rectangle(**TABLE, seed=0, count=3000)
    cloud = joined(near_box, small, table, *others)
    largest, _ = ransac_plane(cloud, up=UP, max_tilt=0.2)
    assert height_of(largest[0]) > 0.29
    plane, _ = supporting_plane(cloud, viewpoint=(0.0, 0.0, 1.5))
    assert abs(height_of(plane[0])) < 0.005  # the feet of the dense box are within the slab


@pytest.mark.parametrize("loaded", ["high", "low"])
def test_of_two_tables_the_one_that_things_stand_on_counts(loaded):
    low = rectangle((-0.4, -0.4, 0.0), (0.8, 0.0, 0.0), (0.0, 0.8, 0.0), seed=0, count=4000)
    high = rectangle((0.5, -0.4, 0.2), (0.8, 0.0, 0.0), (0.0, 0.8, 0.0), seed=1, count=4000)
    x, z = (0.9, 0.2) if loaded == "high" else (0.0, 0.0)
    cloud = joined(low, high, *(box((x, y, z), (0.08, 0.08, 0.1), seed=5) for y in (-0.2, 0.0, 0.2)))
    plane, _ = supporting_plane(cloud, viewpoint=(0.4, 0.0, 1.5))
    assert height_of(plane[0]) == pytest.approx(z, abs=0.002)


@pytest.mark.parametrize("pitch", [20, 45, 70])
def test_an_empty_table_before_a_larger_wall_is_found_by_how_cameras_are_held(pitch):
    cloud = seen_from_camera(joined(rectangle(**WALL, seed=1), rectangle(**TABLE, seed=0)), math.radians(pitch))
    largest, _ = ransac_plane(cloud)
    plane, _ = supporting_plane(cloud, likely_up=(0.0, -1.0, -0.3))
    up = torch.tensor([0.0, -math.cos(math.radians(pitch)), -math.sin(math.radians(pitch))], dtype=torch.float64)
    assert abs(float(largest[0, :3] @ up)) < 0.1
    assert float(plane[0, :3] @ up) > 0.999


@pytest.mark.parametrize("backend", ["torch", "auto"])
def test_a_slice_through_boxes_loses_their_sides_and_surfaces_lose_nothing(backend):
    table = rectangle((-0.5, -0.5, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), seed=0, count=20_000)
    things = [box((x, y, 0.0), (0.1, 0.08, 0.2), seed=4, count=6000) for x in (-0.3, 0.0, 0.3) for y in (-0.2, 0.2)]
    voxels, _, _ = voxel_downsample(joined(table, *things), voxel_size=0.02)
    planes = torch.tensor([[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 1.0, -0.1], [0.0, 0.0, 1.0, -0.2]], dtype=torch.float64)
    apart = (voxels.double() @ planes[:, :3].T + planes[:, 3]).abs()
    label = torch.where(apart.amin(1) < 0.01, apart.argmin(1), -1)
    found = without_slices(voxels, label, planes, 0.01, backend)
    before, after = (torch.bincount(one + 1, minlength=4)[1:].tolist() for one in (label, found))
    assert after[0] > 0.97 * before[0]
    assert after[1] < 0.3 * before[1]  # corners of boxes have no clear surface
    assert after[2] > 0.7 * before[2]
    assert bool(((found == label) | (found == -1)).all())
    one = without_slices(voxels, label.clamp(max=0), planes[:1], 0.01, backend)
    assert torch.equal(one, label.clamp(max=0))


def test_up_and_a_limit_bind_the_search():
    cloud = joined(rectangle(**WALL, seed=1), rectangle(**TABLE, seed=0))
    plane, _ = supporting_plane(cloud, up=UP, max_tilt=0.1)
    assert float(plane[0, 2]) > 0.999
    down, _ = supporting_plane(cloud, up=(0, 0, -1), max_tilt=0.1)
    torch.testing.assert_close(down, -plane)
    with pytest.raises(NoPlaneError, match="no plane within max_tilt of up"):
        supporting_plane(rectangle(**WALL, seed=1), up=UP, max_tilt=0.1)
    with pytest.raises(ConfigError, match="max_tilt is an angle from up"):
        supporting_plane(cloud, max_tilt=0.1)


def test_a_front_that_is_seen_from_below_is_no_table_whatever_up_is_roughly():
    """The normal of a wall before the table points away from a steep camera where it is turned along a rough up.

    Then a ball behind the wall, whose foot on the table is hidden, stands on it.
    """
    pitch, up = math.radians(45), (0.0, -1.0, -0.3)
    front = rectangle((-0.25, -0.3, 0.0), (0.02, 0.0, 0.5), (0.0, 0.6, 0.0), seed=2)
    shell = torch.nn.functional.normalize(torch.randn(5000, 3, generator=seeded(3)), dim=1) * 0.13
    ball = shell + torch.tensor([-0.1, 0.0, 0.3])
    cloud = seen_from_camera(joined(front, ball, rectangle(**TABLE, seed=0)), pitch)
    level = torch.tensor([0.0, -math.cos(pitch), -math.sin(pitch)], dtype=torch.float64)
    for given in ({"likely_up": up}, {"up": up, "viewpoint": (0.0, 0.0, 0.0)}):
        plane, _ = supporting_plane(cloud, **given)
        assert float(plane[0, :3] @ level) > 0.999, given


def test_every_way_to_run_finds_the_same_plane():
    things = [box((x, 0.1, 0.0), (0.08, 0.06, 0.12), seed=9) for x in (0.1, -0.2)]
    clouds = [joined(rectangle(**TABLE, seed=seed), *things) for seed in (0, 1)]
    options = {"probability": 0.999, "viewpoint": (0.0, 0.0, 1.0)}
    found = [supporting_plane(cloud, **options, backend=backend) for cloud in clouds for backend in ("torch", "auto")]
    for (plane, near), (other, also_near) in zip(found[::2], found[1::2]):
        torch.testing.assert_close(plane, other, rtol=0, atol=1e-9)
        assert torch.equal(near, also_near)


def test_a_distance_in_another_unit_is_told():
    with pytest.raises(UnitError, match=r"spans .* times distance=1e-07"):
        supporting_plane(rectangle(**TABLE, seed=0), distance=1e-7)
