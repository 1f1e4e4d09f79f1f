"""Lines that cameras see through, and basins that water would stand in, told on shapes whose answers geometry knows."""

from __future__ import annotations

import math

import pytest
import torch

from pcdata.functional.touching.basins import find_basins
from pcdata.functional.touching.chords import Sight, free_chords
from pcdata.functional.touching.contacts import Contacts
from pcdata.functional.touching.faces import Scene
from pcdata.functional.touching.limits import KINECT_NOISE, Limits
from pcdata.functional.touching.windows import PixelCamera

CAMERA = PixelCamera(100.0, 100.0, 49.5, 49.5)


def sight(depth: torch.Tensor, camera_from_points: torch.Tensor | None = None) -> Sight:
    none = torch.empty(0, dtype=torch.int64)
    inverse = torch.where(depth > 0, 1 / depth.clamp(min=0.1), 0.0)
    label = torch.where(depth > 0, 0, -1)
    contacts = Contacts(none, none, none.double())
    return Sight(
        Scene(inverse, label, torch.zeros(*depth.shape, 3), None, contacts, CAMERA, KINECT_NOISE, Limits()),
        camera_from_points,
    )


def at(u: float, v: float, z: float) -> list[float]:
    return [(u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z]


def test_a_line_over_a_valley_is_free_and_one_over_a_face_or_behind_it_is_not():
    depth = torch.full((100, 100), 1.0, dtype=torch.float64)
    depth[:, 45:55] = 1.1  # a valley of 10 cm width
    points = torch.tensor([at(40, 50, 1.0), at(60, 50, 1.0), at(40, 60, 1.0), at(60, 60, 1.02)], dtype=torch.float64)
    found = free_chords(points, None, [sight(depth)])
    free = {(int(a), int(b)): bool(one) for a, b, one in zip(*found)}
    assert free[0, 1]
    assert not free[0, 2]
    assert len(free) == 6
    behind = free_chords(points + torch.tensor([0, 0, 0.2]), None, [sight(depth)])
    assert not behind.free.any()


def test_where_nothing_was_read_nobody_sees_through():
    depth = torch.full((100, 100), 1.0, dtype=torch.float64)
    depth[:, 45:55] = 0.0
    points = torch.tensor([at(40, 50, 1.0), at(60, 50, 1.0)], dtype=torch.float64)
    assert not free_chords(points, None, [sight(depth)]).free.any()
    side = torch.eye(4, dtype=torch.float64)
    side[2, 3] = -5.0  # the points lie behind that camera
    assert not free_chords(points, None, [sight(depth), sight(depth + 1, side)]).free.any()


def test_points_next_to_each_other_and_far_apart_have_no_line():
    points = torch.tensor([[0, 0, 1.0], [0.01, 0, 1], [0.2, 0, 1], [0.9, 0, 1]], dtype=torch.float64)
    found = free_chords(points, None, [])
    assert [(int(a), int(b)) for a, b in zip(found.first, found.second)] == [(0, 2), (1, 2)]
    assert not found.free.any()
    for count in (0, 1):
        assert len(free_chords(points[:count], None, []).first) == 0


def bowl(radius: float, depth: float, turned: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
    """Return points of half an ellipsoid that stands on the plane, and their heights."""
    grid = torch.linspace(-1.0, 1.0, 121, dtype=torch.float64)
    x, y = torch.meshgrid(grid, grid, indexing="ij")
    inside = x * x + y * y <= 1
    x, y = x[inside], y[inside]
    height = depth * (1 - (1 - x * x - y * y).clamp(min=0).sqrt())
    points = torch.stack([radius * x, radius * y, height], 1)
    return (points if turned is None else points @ turned.T), height


@pytest.mark.parametrize("degrees", [0, 50])
def test_water_stands_in_a_bowl_up_to_its_rim(degrees):
    angle = math.radians(degrees)
    turn = torch.tensor(
        [[1, 0, 0], [0, math.cos(angle), -math.sin(angle)], [0, math.sin(angle), math.cos(angle)]], dtype=torch.float64
    )
    points, height = bowl(0.08, 0.05, turn)
    found = find_basins(points, height)
    assert found is not None
    asked = torch.tensor([[0, 0, 0.02], [0.05, 0, 0.04], [0, 0, 0.08], [0.12, 0, 0.02]], dtype=torch.float64)
    assert found.hold(asked @ turn.T, asked[:, 2]).tolist() == [True, True, False, False]


def test_a_table_a_hill_and_a_cut_bowl_hold_no_water():
    points, height = bowl(0.08, 0.05)
    hill = points * torch.tensor([1, 1, -1.0]) + torch.tensor([0, 0, 0.05])
    cut = points[:, 0] < 0.03
    for some, its in ((hill, hill[:, 2]), (points[cut], height[cut])):
        found = find_basins(some, its)
        assert found is not None
        assert not found.hold(some, its - 0.01).any()


def test_points_that_do_not_tell_which_way_is_up_have_no_basins():
    flat, height = bowl(0.08, 0.0)
    assert find_basins(flat, height) is None
    assert find_basins(flat[:3], height[:3]) is None
    far = torch.tensor([[0.0, 0, 0], [1e6, 0, 0], [0, 1e6, 0.1], [0, 0, 0.2]], dtype=torch.float64)
    assert find_basins(far, far[:, 2]) is None
