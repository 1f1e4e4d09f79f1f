"""What joins the parts of bowls: ramps up to the rim are passed but no surfaces followed; small insides are told."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from pcdata.functional.touching.contacts import Contacts
from pcdata.functional.touching.faces import Scene
from pcdata.functional.touching.joining import (
    Objects,
    _is_hollow,
    join_hollows,
    join_occluded,
    merge_weak_contacts,
)
from pcdata.functional.touching.limits import KINECT_NOISE, RAMP, Limits
from pcdata.functional.touching.windows import PixelCamera
from pcdata.rng import seeded

CAMERA = PixelCamera(500.0, 500.0, 29.5, 19.5)
ROWS, COLUMNS = 40, 60


def scene(inverse: torch.Tensor, height: torch.Tensor, label: torch.Tensor) -> Scene:
    none = torch.empty(0, dtype=torch.int64)
    normals = torch.zeros(*inverse.shape, 3, dtype=torch.float64)
    return Scene(inverse, label, normals, height, Contacts(none, none, none.double()), CAMERA, KINECT_NOISE, Limits())


def rows(values: list[float]) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)[:, None].expand(ROWS, COLUMNS).clone()


def smeared_step(length: int, nearest: float = 0.72) -> Scene:
    """Show a wall before what is above it in the image, 0.8 m away; the step is smeared over rows from 15 on."""
    part = ((torch.arange(ROWS, dtype=torch.float64) - 15) / length).clamp(0, 1)
    inverse = 1 / 0.80 + part * (1 / nearest - 1 / 0.80)
    height = 0.04 + 0.05 * part
    label = (torch.arange(ROWS)[:, None] >= 15 + length // 2).long().expand(ROWS, COLUMNS)
    return scene(rows(inverse.tolist()), rows(height.tolist()), label.clone())


@pytest.mark.parametrize("repeated", [1, 2])
@pytest.mark.parametrize("length", [2, 6, 10])
def test_the_rim_is_seen_over_a_smeared_step(length, repeated):
    found = smeared_step(length)
    if repeated > 1:
        found = scene(*(one[::2].repeat_interleave(2, 0) for one in (found.inverse, found.height, found.label)))
    label = found.label[:, 0]
    contact = int((label == 1).nonzero()[0])  # hangs between both
    assert float(found.height[contact, 0]) < 0.08
    pixels = contact * COLUMNS + torch.arange(COLUMNS)
    assert torch.allclose(found.highest_up_ramps(pixels), torch.tensor(0.09, dtype=torch.float64))


@pytest.mark.parametrize("degrees", [0, 45, 65])
def test_surfaces_are_not_followed(degrees):
    # A plane through (0, 0, 0.8) that comes nearer with the rows: on it 1/z is linear in them.
    down = torch.arange(ROWS, dtype=torch.float64) - CAMERA.cy
    inverse = 1 / 0.8 * (1 + math.tan(math.radians(degrees)) * down / CAMERA.fy)
    flat = scene(rows(inverse.tolist()), rows((0.1 + 0.001 * down).tolist()), torch.zeros(ROWS, COLUMNS).long())
    pixels = torch.arange(ROWS * COLUMNS)[:: ROWS * COLUMNS // 100]
    assert torch.equal(flat.highest_up_ramps(pixels), flat.height.flatten()[pixels])


def test_nor_is_what_another_region_has_or_is_farther_than_ramps_are_long():
    found = smeared_step(6, nearest=0.5)
    label = found.label.clone()
    label[19:] = 2
    other = scene(found.inverse, found.height, label)
    pixels = 18 * COLUMNS + torch.arange(COLUMNS)
    assert torch.equal(other.highest_up_ramps(pixels), other.height[18])
    far = scene(found.inverse, rows([0.04] * 15 + [0.05] * (3 + RAMP + 1) + [0.2] * (ROWS - 19 - RAMP)), found.label)
    assert torch.equal(far.highest_up_ramps(pixels), far.height[18])
    far.height[18 + RAMP] = 0.2
    assert torch.equal(far.highest_up_ramps(pixels), torch.full_like(far.height[18], 0.2))


def cup(radius: float, *, hollow: bool = True) -> Scene:
    """Look straight down, from 0.8 m, at half a ball of some radius, open or upside down, in two regions."""
    rows_, columns = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (ROWS, COLUMNS)), indexing="ij")
    x, y = (columns - CAMERA.cx) / CAMERA.fx * 0.8, (rows_ - CAMERA.cy) / CAMERA.fy * 0.8
    rise = (radius**2 - x * x - y * y).clamp(min=0).sqrt()
    there = x * x + y * y < (0.9 * radius) ** 2
    depth = 0.8 + (rise if hollow else -rise)
    normal = torch.stack([-x, -y, -rise] if hollow else [x, y, -rise], -1) / radius
    label = torch.where(there, (columns > CAMERA.cx + 0.5 * radius * CAMERA.fx / 0.8).long(), -1)
    first = (label[:, :-1] == 0) & (label[:, 1:] == 1)
    pixel = torch.arange(ROWS * COLUMNS).reshape(ROWS, COLUMNS)[:, :-1][first]
    contacts = Contacts(pixel, pixel + 1, torch.ones(len(pixel), dtype=torch.float64))
    inverse = torch.where(there, 1 / depth, 0.0)
    height = torch.where(there, 0.9 - depth, 0.0)
    return Scene(inverse, label, torch.where(there[..., None], normal, 0.0), height, contacts, CAMERA, 1e-3, Limits())


@pytest.mark.parametrize("radius", [0.016, 0.02, 0.03])
def test_the_parts_of_a_small_inside_are_one_and_those_of_a_ball_stay(radius):
    for hollow in (True, False):
        objects = Objects(cup(radius, hollow=hollow))
        assert objects.face([0]).area < 2.2e-3
        join_hollows(objects)
        assert objects.object_of == ([0, 0] if hollow else [0, 1])


@pytest.mark.parametrize("radius", [0.016, 0.02, 0.03])
def test_a_smeared_rim_does_not_hide_that_an_inside_is_hollow(radius):
    clear = cup(radius)
    smeared = clear.normals.clone()
    rim = (clear.label >= 0) & (clear.inverse < clear.inverse[clear.label >= 0].quantile(0.4))
    lean = math.radians(80)
    smeared[rim] = torch.tensor([0.0, math.sin(lean), -math.cos(lean)], dtype=torch.float64)
    label = torch.where(clear.label >= 0, 0, -1)
    faces = [Objects(replace(clear, label=label, normals=one)).face([0]) for one in (clear.normals, smeared)]
    assert all(face.hollow[0] > 0.2 and face.hollow[1] > 0.95 for face in faces)


def two_bowls(apart: float, *, radius: float = 0.03, rows_in_contact: int = ROWS) -> Objects:
    """Look straight down, from 0.8 m, at two half balls beside each other, each so many radii from the line between."""
    rows_, columns = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (ROWS, COLUMNS)), indexing="ij")
    x, y = (columns - CAMERA.cx) / CAMERA.fx * 0.8, (rows_ - CAMERA.cy) / CAMERA.fy * 0.8
    x = x - torch.where(x > 0, apart * radius, -apart * radius)
    rise = (radius**2 - x * x - y * y).clamp(min=0).sqrt()
    there = x * x + y * y < (0.9 * radius) ** 2
    normal = torch.where(there[..., None], torch.stack([-x, -y, -rise], -1) / radius, 0.0)
    label = torch.where(there, (columns > CAMERA.cx).long(), -1)
    beside = (label[:, 29] == 0) & (label[:, 30] == 1) & ((rows_[:, 0] - CAMERA.cy).abs() < rows_in_contact / 2)
    pixel = beside.nonzero().squeeze(1) * COLUMNS + 29
    contacts = Contacts(pixel, pixel + 1, torch.ones(len(pixel), dtype=torch.float64))
    flat = torch.where(there, 1 / (0.8 + rise), 0.0)
    return Objects(Scene(flat, label, normal, 0.1 - rise, contacts, CAMERA, 1e-3, Limits()))


@pytest.mark.parametrize(
    ("apart", "rows_in_contact", "are_one"), [(0.5, ROWS, True), (0.82, ROWS, False), (0.5, 6, False)]
)
def test_two_bowls_that_meet_over_their_rims_or_along_little_stay_two(apart, rows_in_contact, are_one):
    objects = two_bowls(apart, rows_in_contact=rows_in_contact)
    assert all(_is_hollow(objects.face([one])) for one in (0, 1))
    assert objects.length_of((0, 1)) > 5 * 0.0016
    join_hollows(objects)
    assert objects.object_of == ([0, 0] if are_one else [0, 1])


@pytest.mark.parametrize("num_regions", [1, 2])
def test_two_sides_of_a_corner_are_no_inside(num_regions):
    # Two noisy planes that lean toward each other, a fifth of the points on one: pairs across rise, of others half.
    columns = torch.arange(COLUMNS, dtype=torch.float64)
    side = (columns > 11.5).double()
    lean = math.radians(20) * (2 * side - 1)
    normal = torch.stack([-lean.sin(), torch.zeros_like(lean), -lean.cos()], -1).expand(ROWS, COLUMNS, 3)
    depth = 0.8 - math.tan(math.radians(20)) * 0.8 / CAMERA.fx * (columns - 11.5).abs()
    depth = depth + 0.001 * torch.randn(ROWS, COLUMNS, generator=seeded(2)).double()
    label = (side if num_regions == 2 else 0 * side).long().expand(ROWS, COLUMNS).clone()
    face = Objects(replace(scene(1 / depth, depth, label), normals=normal.clone())).face(list(range(num_regions)))
    assert face.hollow[0] > 0.06
    assert 0.6 < face.hollow[1] < 0.72
    assert _is_hollow(face, num_regions) == (num_regions == 1)


@pytest.mark.parametrize("every", [2, 4])
def test_what_was_not_read_between_two_parts_of_a_face_says_nothing(every):
    label = (torch.arange(COLUMNS) >= 30).long().expand(ROWS, COLUMNS).clone()
    inverse = torch.full((ROWS, COLUMNS), 1 / 0.8, dtype=torch.float64)
    inverse[::every, 29:31], label[::every, 29:31] = 0, -1
    objects = Objects(scene(inverse, torch.zeros_like(inverse), label))
    _, between = objects.face([0]).way_to(objects.face([1]))
    assert objects.scene.seen_between(between)[3] > 0.1  # of the way nothing is known
    join_occluded(objects)
    assert objects.object_of == [0, 0]


@pytest.mark.parametrize(
    ("rows_in_contact", "strength", "are_one"), [(2, 0.0, False), (20, 0.0, True), (20, 0.5, False)]
)
def test_two_faces_are_one_where_their_contact_is_weak_and_not_short(rows_in_contact, strength, are_one):
    label = (torch.arange(COLUMNS) >= 30).long().expand(ROWS, COLUMNS).clone()
    flat = torch.full((ROWS, COLUMNS), 1 / 0.8, dtype=torch.float64)
    first = torch.arange(rows_in_contact) * COLUMNS + 29
    contacts = Contacts(first, first + 1, torch.full((rows_in_contact,), strength, dtype=torch.float64))
    objects = Objects(replace(scene(flat, torch.zeros_like(flat), label), contacts=contacts))
    assert objects.length_of((0, 1)) == pytest.approx(rows_in_contact * 0.8 / 500)
    merge_weak_contacts(objects)
    assert objects.object_of == ([0, 0] if are_one else [0, 1])


@pytest.mark.parametrize(("rows_of_each", "are_one"), [(4, False), (6, True)])
def test_contacts_add_up_as_objects_grow(rows_of_each, are_one):
    # Two regions that touch each other, and a third: each for itself along too little.
    label = torch.zeros(ROWS, COLUMNS, dtype=torch.int64)
    label[:20, 30:], label[20:, 30:] = 1, 2
    flat = torch.full((ROWS, COLUMNS), 1 / 0.8, dtype=torch.float64)
    beside = (torch.arange(2 * rows_of_each) + 20 - rows_of_each) * COLUMNS + 29
    below = 19 * COLUMNS + torch.arange(30, 60)
    first, second = torch.cat([beside, below]), torch.cat([beside + 1, below + COLUMNS])
    contacts = Contacts(first, second, torch.zeros(len(first), dtype=torch.float64))
    objects = Objects(replace(scene(flat, torch.zeros_like(flat), label), contacts=contacts))
    merge_weak_contacts(objects)
    assert objects.object_of == ([0, 0, 0] if are_one else [0, 1, 1])


def behind_a_post(*, lower: float) -> Objects:
    """Look straight down at two tops beside a nearer post, one of them so many metres lower."""
    depth = torch.full((ROWS, COLUMNS), 0.8, dtype=torch.float64)
    depth[:, 40:] += lower
    depth[:, 20:40] = 0.6
    depth += 0.001 * torch.randn(ROWS, COLUMNS, generator=seeded(5)).double()
    label = torch.tensor([0] * 20 + [1] * 20 + [2] * 20).expand(ROWS, COLUMNS).clone()
    return Objects(scene(1 / depth, torch.zeros_like(depth), label))


@pytest.mark.parametrize("lower", [0.0, 0.002, 0.01, 0.02, -0.02])
def test_tops_of_one_height_behind_something_are_one_and_those_of_two_heights_stay(lower):
    objects = behind_a_post(lower=lower)
    join_occluded(objects)
    assert objects.object_of == ([0, 1, 0] if abs(lower) < 0.005 else [0, 1, 2])


@pytest.mark.parametrize("side", [16, 24])
def test_a_smeared_border_does_not_turn_the_plane_of_a_face(side):
    # On one side the last columns run toward what is 9 cm behind.
    depth = torch.full((ROWS, COLUMNS), 0.8, dtype=torch.float64)
    depth[:, 30 + side - 2 : 30 + side] += torch.tensor([0.03, 0.06])
    label = torch.full((ROWS, COLUMNS), -1)
    label[:, 30 - side : 30 + side] = 0
    face = Objects(scene(1 / depth, torch.zeros_like(depth), label)).face([0])
    turned = torch.linalg.eigh(torch.cov(face.points.T)).eigenvectors[:, 0]
    assert abs(float(turned[2])) < math.cos(math.radians(9))
    assert abs(float(face.normal[2])) > math.cos(math.radians(1))
    assert face.rms < 0.002


def cup_in_parts(*, before: float = 0.06) -> Objects:
    """Look straight down at a cone of normals that lean inward: its bottom 0, and around it halves 1 and 2, 3 beside.

    The bottom has joined half 1, whose top lies so many metres above the table; the contacts with half 2 are strong.
    """
    rows_, columns = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (ROWS, COLUMNS)), indexing="ij")
    x, y = columns - CAMERA.cx, rows_ - CAMERA.cy
    away = (x * x + y * y).sqrt()
    label = torch.full((ROWS, COLUMNS), 3)
    label[away < 18] = 1
    label[(away < 18) & (x > 0)] = 2
    label[away < 12] = 0
    inside = label == 0
    depth = torch.where(inside, 0.81 - 0.005 * away / 12, 0.80)
    normal = torch.stack([-0.5 * x / away.clamp(min=1), -0.5 * y / away.clamp(min=1), -torch.ones_like(x)], -1)
    normal = torch.where(inside[..., None], normal / normal.norm(dim=-1, keepdim=True), torch.tensor([0.0, 0.0, -1.0]))
    height = torch.where(inside, 0.04, 0.06)
    height[label == 1] = before
    pixel = torch.arange(ROWS * COLUMNS).reshape(ROWS, COLUMNS)
    pairs = [(label[:, :-1], label[:, 1:], pixel[:, :-1], pixel[:, 1:]), (label[:-1], label[1:], pixel[:-1], pixel[1:])]
    first, second = (torch.cat([one[place][one[0] != one[1]] for one in pairs]) for place in (2, 3))
    contacts = Contacts(first, second, torch.ones(len(first), dtype=torch.float64))
    objects = Objects(Scene(1 / depth, label, normal, height, contacts, CAMERA, KINECT_NOISE, Limits()))
    objects.join(0, 1)
    return objects


def test_what_encloses_an_inside_is_its_wall_though_it_has_joined_a_part_of_it():
    objects = cup_in_parts()
    assert objects.scene.sides(0)[0] == objects.scene.sides(0)[1] == objects.scene.sides(0)[4] == 0
    join_hollows(objects)
    assert objects.object_of == [0, 0, 0, 3]
    assert objects.joins == [(0, "hollow")]


def test_it_is_not_where_a_part_of_what_encloses_it_is_lower():
    objects = cup_in_parts(before=0.03)
    join_hollows(objects)
    assert objects.object_of == [0, 0, 2, 3]
    assert not objects.joins


def test_sides_are_counted_at_the_border_of_the_image_too():
    label = torch.tensor([[0, 0, 1], [-1, 0, 1]])
    found = scene(torch.ones(2, 3, dtype=torch.float64), torch.zeros(2, 3, dtype=torch.float64), label)
    assert found.sides(0) == [6, 0, 2]
    assert found.sides(1) == [4, 2, 0]
