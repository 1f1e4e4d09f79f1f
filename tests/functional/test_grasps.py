"""Grasps against a table and points, held to brute force in float64."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from pcdata.errors import ConfigError, PoseError
from pcdata.functional import ParallelJaw, check_grasps
from pcdata.rng import seeded

PANDA = ParallelJaw(
    opening=0.08,
    finger_length=0.045,
    finger_thickness=0.01,
    finger_width=0.02,
    palm_length=0.06,
    palm_span=0.2,
    palm_width=0.06,
    tip=0.1034,
)
TABLE = torch.tensor([0.0, 0.0, 1.0, -0.1], dtype=torch.float64)  # z = 0.1


def poses(count: int, seed: int = 0, *, spread: float = 0.2) -> Tensor:
    """Random rigid (count, 4, 4) float64."""
    generator = seeded(seed)
    rotation = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))[0]
    rotation[:, :, 0] *= torch.linalg.det(rotation)[:, None]
    grasps = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    grasps[:, :3, :3] = rotation
    grasps[:, :3, 3] = spread * torch.rand(count, 3, generator=generator, dtype=torch.float64)
    return grasps


def by_brute_force(points: np.ndarray, grasp: np.ndarray, opening: float, gripper: ParallelJaw) -> tuple[int, int]:
    """Count points in palm or fingers, and between the fingers, one at a time."""
    letters = "xyz"
    approach, closing = letters.index(gripper.approach), letters.index(gripper.closing)
    across = 3 - approach - closing
    hits = held = 0
    start, tip = gripper.tip - gripper.finger_length, gripper.tip
    for point in points:
        own = np.linalg.inv(grasp) @ np.append(point, 1.0)
        a, c, w = own[approach], abs(own[closing]), abs(own[across])
        palm_half = gripper.palm_span / 2 if gripper.palm_span else opening / 2 + gripper.finger_thickness
        in_palm = start - gripper.palm_length <= a <= start and c <= palm_half
        in_palm = in_palm and w <= (gripper.palm_width or gripper.finger_width) / 2
        between = start < a <= tip and w <= gripper.finger_width / 2
        in_finger = between and opening / 2 <= c <= opening / 2 + gripper.finger_thickness
        hits += in_palm or in_finger
        held += between and c <= opening / 2
    return hits, held


@pytest.mark.parametrize(
    "gripper",
    [PANDA, ParallelJaw(**{**vars(PANDA), "approach": "x", "closing": "y", "tip": 0.02, "palm_span": None})],
    ids=["z approaches", "x approaches"],
)
def test_points_in_the_gripper_are_those_of_brute_force(gripper):
    points = 0.3 * torch.rand(400, 3, generator=seeded(1))
    grasps = poses(25)
    openings = 0.02 + 0.06 * torch.rand(25, generator=seeded(2), dtype=torch.float64)
    found = check_grasps(points, grasps=grasps, gripper=gripper, openings=openings)
    expected = [
        by_brute_force(points.double().numpy(), grasp, float(opening), gripper)
        for grasp, opening in zip(grasps.numpy(), openings)
    ]
    assert list(zip(found.hits.tolist(), found.held.tolist())) == expected
    assert sum(hits > 0 for hits, _ in expected) > 5
    assert sum(held > 0 for _, held in expected) > 2


def test_angle_and_clearance_are_those_of_the_corners():
    grasps = poses(60)
    found = check_grasps(torch.zeros(0, 3), grasps=grasps, gripper=PANDA, plane=TABLE)
    assert found.hits.tolist() == [0] * 60
    for number, grasp in enumerate(grasps):
        down = -grasp[2, 2]  # of the approach, z of the gripper
        assert float(found.angle[number]) == pytest.approx(math.acos(float(down)), abs=1e-9)
        corners = []
        for x, y, z in (
            (0.1, 0.03, (0.0584 - 0.06, 0.0584)),  # palm
            (0.05, 0.01, (0.0584, 0.1034)),  # fingers, both outer faces
        ):
            corners += [[sx * x, sy * y, one, 1.0] for sx in (-1, 1) for sy in (-1, 1) for one in z]
        heights = (grasp @ torch.tensor(corners, dtype=torch.float64).T)[2] - 0.1
        assert float(found.clearance[number]) == pytest.approx(float(heights.min()), abs=1e-9)


def test_a_grasp_straight_down_is_at_angle_0_and_one_from_below_beyond_90_degrees():
    down = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    down[2, 3] = 0.1 + 0.1034 + 0.01  # tips 1 cm over the table
    below = torch.eye(4, dtype=torch.float64)
    found = check_grasps(torch.zeros(0, 3), grasps=torch.stack([down, below]), gripper=PANDA, plane=TABLE)
    assert found.angle.tolist() == pytest.approx([0.0, math.pi], abs=1e-7)
    assert found.clearance.tolist() == pytest.approx([0.01, 0.0584 - 0.06 - 0.1])


def test_wrong_grasps_and_grippers_are_refused():
    points = torch.zeros(0, 3)
    with pytest.raises(PoseError, match=r"check_grasps: grasps: pose 1 is not rigid"):
        check_grasps(points, grasps=poses(3) * torch.tensor([1.0, 1.1, 1.0])[:, None, None], gripper=PANDA)
    for opening in (0.0, 0.09):
        with pytest.raises(ConfigError, match=r"openings must be above 0 and at most the gripper's 0\.08"):
            check_grasps(points, grasps=poses(1), gripper=PANDA, openings=torch.tensor([opening]))
    for field, value in (("finger_width", 0.0), ("tip", math.nan), ("approach", "w"), ("closing", "z")):
        with pytest.raises(ConfigError, match=f"ParallelJaw: .*{field}"):
            ParallelJaw(**{**vars(PANDA), field: value})


@pytest.mark.parametrize("field", ["opening", "finger_length", "tip", "palm_span"])
def test_a_gripper_in_millimetres_is_refused(field: str):
    good = {"opening": 0.08, "finger_length": 0.045, "finger_thickness": 0.01, "finger_width": 0.02}
    good |= {"palm_length": 0.06, "palm_span": 0.2, "tip": 0.1034}
    ParallelJaw(**good)
    with pytest.raises(
        ConfigError, match=rf"{field} must be in metres, .* is it in millimetres\? Those are {good[field]:g} m"
    ):
        ParallelJaw(**good | {field: 1000 * good[field]})


def test_grasps_far_from_all_points_are_of_another_unit_or_frame():
    points = torch.rand(500, 3, generator=seeded(3)) + torch.tensor([0.3, 0.0, 0.1])
    grasps = poses(5) + 0.0
    grasps[:, :3, 3] += 0.4
    in_millimetres = grasps.clone()
    in_millimetres[:, :3, 3] *= 1000
    with pytest.raises(PoseError, match=r"the nearest of 5 grasps lies \d+ m from the points, .* millimetres"):
        check_grasps(points, grasps=in_millimetres, gripper=PANDA)
    in_millimetres[2] = grasps[2]  # one that is near: the others are wild, not of another unit
    check_grasps(points, grasps=in_millimetres, gripper=PANDA)
    grasps[:, 0, 3] += 8.0  # a small cloud, and a robot that waits across the room
    check_grasps(0.01 * points, grasps=grasps, gripper=PANDA)
    check_grasps(points[:0], grasps=in_millimetres[:1], gripper=PANDA)
    check_grasps(points, grasps=in_millimetres[:0], gripper=PANDA)
    with pytest.raises(ConfigError, match="tips must be in metres"):
        check_grasps(points, grasps=grasps, gripper=PANDA, tips=torch.full((5,), 20.0))
