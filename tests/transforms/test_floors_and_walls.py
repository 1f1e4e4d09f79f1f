"""The table among the floor below it and the walls around it: an empty one, and where it ends."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from pcdata.functional import supporting_plane
from pcdata.functional.plane_surfaces import plane_surfaces
from pcdata.rng import seeded
from pcdata.structures import PointCloud
from pcdata.synthetic import tabletop
from pcdata.transforms import (
    Compose,
    Deproject,
    RandomSensorNoise,
    RemovePlane,
    ToFrame,
    plane_hulls_in_cloud,
    planes_in_cloud,
)
from tests.rooms import seen_room, standing
from tests.tables import TABLE as TABLE_SIZE
from tests.tables import box, rectangle

KINECT = 0.0026
STEP = RemovePlane(which="supporting", probability=0.9999)
TABLE = ((-0.5, -0.4, -0.04), (0.5, 0.4, 0.0))
LEGS = [standing(x, y, (0.05, 0.05, 0.66), base=-0.7) for x in (-0.45, 0.45) for y in (-0.35, 0.35)]
FLOOR = ((-4.0, -4.0, -0.75), (4.0, 4.0, -0.7))
WALL = ((-3.0, 0.6, -0.7), (3.0, 0.7, 1.5))
CARTON = standing(0.1, 0.0, (0.3, 0.25, 0.25))


def plane_height(room: PointCloud, pitch: float, distance: float) -> float:
    """Height of the plane that is found over the table's top, in metres."""
    plane = planes_in_cloud(STEP(room))[0]
    up = torch.tensor([0.0, -math.cos(pitch), -math.sin(pitch)], dtype=torch.float64)
    assert float(plane[:3] @ up) > 0.99
    return distance * math.sin(pitch) - float(plane[3])


# -- where nothing stands on any plane ---------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [None, "stereo"])
@pytest.mark.parametrize(("seed", "num_objects"), [(0, 0), (3, 0), (7, 0), (2, 1), (4, 2)])
def test_a_bare_table_wins_over_the_larger_floor_around_it(seed, num_objects, noise):
    scene = tabletop(seed, num_objects, size=(240, 320), noise=noise)
    plane = planes_in_cloud(STEP(Deproject()(scene.frame)))[0]
    assert float(plane[3]) == pytest.approx(float(scene.truth.world_from_camera[0, 2, 3]), abs=0.02)


@pytest.mark.parametrize("fields", [{}, {"max_tilt": 0.2, "probability": 0.9999}], ids=["plain", "limited"])
@pytest.mark.parametrize(
    ("touching", "num_objects", "seed"),
    [(True, 12, 3), (True, 20, 4), (True, 20, 7), (False, 12, 3), (False, 20, 2), (False, 20, 6)],
)
def test_no_slice_of_a_heap_is_the_table(touching, num_objects, seed, fields):
    scene = tabletop(seed, num_objects, 1, size=(240, 320), touching=touching, floor=False)
    steps = Compose([RandomSensorNoise(sensor="kinect_v1"), Deproject(), ToFrame(frame="base")])
    cloud = steps(scene.frame, generator=seeded(seed))
    table = RemovePlane(which="supporting", up=(0, 0, 1), frame="base", **fields)
    plane = planes_in_cloud(table(cloud))[0]
    assert torch.allclose(plane, torch.tensor([0.0, 0.0, 1.0, 0.0], dtype=torch.float64), atol=0.005)


@pytest.mark.parametrize("noise", [0.0, KINECT])
@pytest.mark.parametrize(("degrees", "distance"), [(30, 1.2), (45, 1.6), (60, 1.6), (40, 2.4)])
@pytest.mark.parametrize("legs", [0, 4])
def test_a_bare_table_is_found_near_and_far_with_legs_and_without(legs, degrees, distance, noise):
    pitch = math.radians(degrees)
    room = seen_room([TABLE, *LEGS[:legs], FLOOR], pitch=pitch, distance=distance, noise=noise, scale=1.5)
    assert abs(plane_height(room, pitch, distance)) < 0.03


@pytest.mark.parametrize("noise", [0.0, KINECT])
@pytest.mark.parametrize("degrees", [35, 60, 89])
@pytest.mark.parametrize("things", [[CARTON], [standing(-0.3, 0.1, (0.4, 0.3, 0.3)), CARTON]], ids=["one", "two"])
def test_cartons_alone_on_a_floor_or_a_table_are_not_the_table(things, degrees, noise):
    pitch = math.radians(degrees)
    for ground in (((-4.0, -4.0, -0.05), (4.0, 4.0, 0.0)), TABLE):
        room = seen_room([ground, *things], pitch=pitch, distance=1.5, noise=noise)
        assert abs(plane_height(room, pitch, 1.5)) < 0.03


def test_things_on_a_floor_make_it_the_floor_though_a_bare_shelf_is_above():
    ground, shelf = ((-4.0, -4.0, -0.05), (4.0, 4.0, 0.0)), ((-0.9, 0.5, 0.4), (0.9, 1.0, 0.42))
    things = [standing(x, -0.1, (0.1, 0.08, 0.15)) for x in (-0.3, 0.0, 0.3)]
    pitch = math.radians(45)
    assert abs(plane_height(seen_room([ground, shelf, *things], pitch=pitch, distance=1.6), pitch, 1.6)) < 0.01


@pytest.mark.parametrize("up", [None, (0.0, 0.0, 1.0)])
@pytest.mark.parametrize("viewpoint", [None, (0.0, -0.5, 1.2)])
def test_a_bare_table_is_found_in_a_level_frame(up, viewpoint):
    floor = rectangle((-1.5, -1.5, -0.75), (3.0, 0.0, 0.0), (0.0, 3.0, 0.0), count=12_000)
    cloud = torch.cat([floor, rectangle(**TABLE_SIZE)])
    if viewpoint is None and up is None:
        cloud = cloud - torch.tensor([0.0, 0.0, 1.2])  # seen from the origin
    level = -1.2 if viewpoint is None and up is None else 0.0
    plane, _ = supporting_plane(cloud, up=up, viewpoint=viewpoint)
    assert -float(plane[0, 3] / plane[0, 2]) == pytest.approx(level, abs=0.01)


def test_a_ceiling_is_above_and_not_the_table():
    floor = rectangle((-1.5, -1.5, 0.0), (3.0, 0.0, 0.0), (0.0, 3.0, 0.0), count=12_000)
    ceiling = rectangle((-1.4, -1.4, 2.5), (2.8, 0.0, 0.0), (0.0, 2.8, 0.0), count=11_000)
    plane, _ = supporting_plane(torch.cat([floor, ceiling]), up=(0, 0, 1), viewpoint=(0.0, 0.0, 1.5))
    assert abs(float(plane[0, 3])) < 0.01


# -- where the table ends ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gap", [0.0, 0.2])
@pytest.mark.parametrize("cut", ["slab", "measured"])
@pytest.mark.parametrize("noise", [0.0, KINECT / 2])
def test_the_hull_of_a_table_ends_where_the_table_does_and_not_along_the_wall(noise, cut, gap):
    wall = ((-3.0, 0.4 + gap, -0.7), (3.0, 0.7, 1.5))
    beside = standing(-0.85, 0.2, (0.1, 0.1, 0.9), base=-0.7)
    on = [standing(-0.3, 0.25, (0.1, 0.1, 0.12)), standing(0.3, 0.2, (0.1, 0.08, 0.15))]
    room = seen_room([TABLE, wall, *on, beside], noise=noise, pitch=math.radians(35), distance=1.4, scale=1.5)
    over = RemovePlane(which="supporting", cut=cut, probability=0.9999, keep="over")(room)
    (hull,) = plane_hulls_in_cloud(over)
    x = hull[:, 0]  # the camera looks along y, so its x is the room's
    assert 0.45 < float(x.max()) < 0.58  # a cell more along the wall
    assert -0.58 < float(x.min()) < -0.45
    assert int((over.labels == 4).sum()) == 0
    if gap:  # noise moves a wall at the table's edge over the table
        assert int((over.labels == 1).sum()) == 0
    for label in (2, 3):
        assert float((over.labels == label).sum()) > 0.8 * float((room.labels == label).sum())


def patch_of(*parts: Tensor, distance: float = 0.01) -> list[float]:
    """Share of each part near the plane z = 0 that is of its surface."""
    points = torch.cat(parts)
    plane = torch.tensor([[0.0, 0.0, 1.0, 0.0]], dtype=torch.float64)
    near = points[:, 2].abs() < distance
    patch, _, _ = plane_surfaces(points, torch.tensor([0, len(points)]), near, plane, distance)
    assert not bool((patch & ~near).any())
    sizes = [len(part) for part in parts]
    return [
        float(own.sum() / its.sum().clamp(min=1))
        for own, its in zip(patch.split(sizes), near.split(sizes), strict=True)
    ]


@pytest.mark.parametrize("count", [300, 3000, 100_000])
def test_the_surface_is_all_of_a_table_however_dense(count):
    assert patch_of(rectangle(**TABLE_SIZE, count=count)) == [1.0]


@pytest.mark.parametrize("count", [3000, 100_000])
def test_the_surface_is_neither_the_wall_nor_strays_at_its_height(count):
    wall = rectangle((0.8, -2.0, -1.0), (0.0, 4.0, 0.0), (0.0, 0.0, 2.5), count=3 * count)
    strays = torch.rand(20, 3, generator=seeded(0)) * 0.001 + torch.tensor([-2.0, 0.0, 0.0])
    table, strip, far = patch_of(rectangle(**TABLE_SIZE, count=count), wall, strays)
    assert table > 0.99
    assert strip == far == 0.0


def test_both_sides_of_a_table_that_a_thing_parts_are_its_surface():
    left = rectangle((-0.6, -0.4, 0.0), (0.5, 0.0, 0.0), (0.0, 0.8, 0.0), count=8000)
    right = rectangle((0.2, -0.4, 0.0), (0.3, 0.0, 0.0), (0.0, 0.8, 0.0), count=5000)
    assert min(patch_of(left, right, box((0.05, 0.0, 0.0), (0.3, 0.8, 0.3), count=6000))[:2]) > 0.97


@pytest.mark.parametrize("count", [0, 1, 3])
def test_few_points_are_their_own_surface(count):
    assert patch_of(torch.rand(count, 3, generator=seeded(1)) * 0.005, rectangle(**TABLE_SIZE, count=0))[0] in (0, 1)
