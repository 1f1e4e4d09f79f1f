"""Grasps of other projects, held to what their own code draws and computes, written anew from their formulas."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from torch import Tensor

from pcdata.errors import ConfigError, NonFiniteError, PoseError, ShapeError
from pcdata.functional import (
    GRASP_CONVENTIONS,
    GraspConvention,
    ParallelJaw,
    check_grasps,
    convert_grasps,
    read_grasp_group,
)
from pcdata.rng import seeded

PANDA = ParallelJaw(
    opening=0.08, finger_length=0.045, finger_thickness=0.01, finger_width=0.02, palm_length=0.06, tip=0.1034
)


def directions(count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Unit approaches and closing directions (count, 3) at right angles."""
    drawn = torch.randn(2, count, 3, generator=seeded(seed), dtype=torch.float64)
    approach = torch.nn.functional.normalize(drawn[0], dim=1)
    closing = drawn[1] - (drawn[1] * approach).sum(1, keepdim=True) * approach
    return approach, torch.nn.functional.normalize(closing, dim=1)


def poses(columns: list[Tensor], origin: Tensor) -> Tensor:
    grasps = torch.eye(4, dtype=torch.float64).repeat(len(origin), 1, 1)
    grasps[:, :3, :3], grasps[:, :3, 3] = torch.stack(columns, 2), origin
    return grasps


def from_contacts(contact: Tensor, approach: Tensor, base: Tensor, width: Tensor) -> Tensor:
    """Contact-GraspNet's 6-DoF grasps (Sundermeyer et al., ICRA 2021, equation 1): R = [b, a x b, a], and the origin
    half the width along b and the depth of the gripper, 0.1034 m, back along a from the contact."""
    origin = contact + width[:, None] / 2 * base - 0.1034 * approach
    return poses([base, torch.linalg.cross(approach, base), approach], origin)


def drawn_fingers(row: Tensor) -> tuple[Tensor, Tensor]:
    """Where graspnetAPI draws the tips of the fingers of a row of 17: at x = depth, y = -+width / 2 in the grasp."""
    width, depth, rotation, center = row[1], row[3], row[4:13].reshape(3, 3), row[13:16]
    return tuple(center + rotation @ torch.stack([depth, side * width / 2, 0 * depth]) for side in (-1, 1))  # type: ignore[return-value]


def group_rows(count: int) -> Tensor:
    """Rows of a GraspGroup: x of the rotation is the approach, y the closing direction."""
    approach, closing = directions(count, 4)
    generator = seeded(5)
    width = 0.02 + 0.06 * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    depth = 0.01 * torch.randint(1, 5, (count, 1), generator=generator).double()
    rotation = torch.stack([approach, closing, torch.linalg.cross(approach, closing)], 2).reshape(count, 9)
    place = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    score, height = torch.rand(count, 1, generator=generator, dtype=torch.float64), torch.full((count, 1), 0.02)
    return torch.cat([score, width, height, depth, rotation, place, torch.arange(count).double()[:, None]], 1)


def tips_of(grasps: Tensor, convention: GraspConvention, tips: Tensor | float, width: Tensor) -> Tensor:
    """Both finger tips (G, 2, 3) of grasps written in a convention."""
    approach, closing = (grasps[:, :3, "xyz".index(axis)] for axis in convention[:2])
    middle = grasps[:, :3, 3] + torch.as_tensor(tips).expand(len(grasps))[:, None] * approach
    return torch.stack([middle + side * width[:, None] / 2 * closing for side in (-1, 1)], 1)


def test_contact_graspnet_and_graspnet_write_the_same_fingers():
    approach, base = directions(30)
    contact, width = torch.rand(30, 3, generator=seeded(1)).double(), torch.full((30,), 0.06).double()
    grasps = from_contacts(contact, approach, base, width)
    depth = torch.linspace(0.01, 0.04, 30, dtype=torch.float64)
    as_graspnet = convert_grasps(grasps, source="contact_graspnet", target="graspnet", target_tips=depth)
    torch.testing.assert_close(as_graspnet[:, :3, 0], approach)
    torch.testing.assert_close(as_graspnet[:, :3, 1], base)
    # The contact is a finger tip of Contact-GraspNet's grasp; graspnetAPI draws one there too.
    zero = torch.zeros(30, 1, dtype=torch.float64)
    rows = torch.cat(
        [
            zero,
            width[:, None],
            zero,
            depth[:, None],
            as_graspnet[:, :3, :3].reshape(30, 9),
            as_graspnet[:, :3, 3],
            zero,
        ],
        1,
    )
    for row, touched in zip(rows, contact):
        torch.testing.assert_close(drawn_fingers(row)[0], touched, atol=1e-12, rtol=0)
    back = convert_grasps(as_graspnet, source="anygrasp", target="m2t2", source_tips=depth)
    torch.testing.assert_close(back, grasps, atol=1e-12, rtol=0)


def test_the_rows_of_a_grasp_group_are_read_as_they_are_drawn():
    rows = group_rows(20)
    group = read_grasp_group(rows)
    convention = GRASP_CONVENTIONS["graspnet"]
    fingers = tips_of(group.grasps, convention, group.tips, group.openings)
    for row, pair in zip(rows, fingers):
        torch.testing.assert_close(torch.stack(drawn_fingers(row)), pair, atol=1e-12, rtol=0)
    assert torch.equal(group.scores, rows[:, 0])
    assert group.objects.tolist() == list(range(20))
    with pytest.raises(PoseError, match="read_grasp_group: rotations: pose 0 is not rigid"):
        read_grasp_group(rows * 1.01)
    with pytest.raises(ShapeError, match="rows"):
        read_grasp_group(rows[:, :16])


@pytest.mark.parametrize(("old", "new"), list(itertools.permutations(itertools.permutations("xyz", 2), 2)))
def test_fingers_stay_where_they_are_between_any_two_axes(old, new):
    source, target = GraspConvention(*old, 0.03), GraspConvention(*new, 0.1)
    approach, closing = directions(8, 2)
    third = torch.linalg.cross(approach, closing)
    columns = {old[0]: approach, old[1]: closing}
    missing = next(axis for axis in "xyz" if axis not in old)
    own = torch.stack([columns.get(axis, third) for axis in "xyz"], 2)
    columns[missing] = third * torch.linalg.det(own)[:, None]
    grasps = poses([columns[axis] for axis in "xyz"], torch.rand(8, 3, generator=seeded(3)).double())
    found = convert_grasps(grasps, source=source, target=target)
    assert torch.linalg.det(found[:, :3, :3]).tolist() == pytest.approx([1.0] * 8)
    width = torch.full((8,), 0.05, dtype=torch.float64)
    torch.testing.assert_close(tips_of(found, target, 0.1, width), tips_of(grasps, source, 0.03, width))
    # The same gripper, its axes named either way, hits and holds the same.
    points = 1.2 * torch.rand(20_000, 3, generator=seeded(6))
    grippers = [
        ParallelJaw(**{**vars(PANDA), "approach": one.approach, "closing": one.closing, "tip": one.tip})
        for one in (source, target)
    ]
    checks = [check_grasps(points, grasps=g, gripper=jaw) for g, jaw in zip((grasps, found), grippers)]
    assert torch.equal(checks[0].hits, checks[1].hits)
    assert torch.equal(checks[0].held, checks[1].held)
    assert int(checks[0].held.sum()) > 0


def test_every_grasp_may_have_tips_of_its_own():
    rows = group_rows(12)
    group = read_grasp_group(rows)
    jaw = ParallelJaw(**{**vars(PANDA), "approach": "x", "closing": "y", "tip": 0.0, "opening": 0.1})
    points = torch.rand(5000, 3, generator=seeded(0))
    plane = torch.tensor([0.0, 0.0, 1.0, 0.2], dtype=torch.float64)
    together = check_grasps(
        points, grasps=group.grasps, gripper=jaw, openings=group.openings, tips=group.tips, plane=plane
    )
    for k, depth in enumerate(group.tips.tolist()):
        own = ParallelJaw(**{**vars(jaw), "tip": depth})
        alone = check_grasps(
            points, grasps=group.grasps[k : k + 1], gripper=own, openings=group.openings[k : k + 1], plane=plane
        )
        assert float(together.clearance[k]) == pytest.approx(float(alone.clearance[0]))
        assert (int(together.hits[k]), int(together.held[k])) == (int(alone.hits[0]), int(alone.held[0]))
    with pytest.raises(NonFiniteError, match="tips"):
        check_grasps(points, grasps=group.grasps, gripper=jaw, tips=group.tips * math.nan)


def test_unknown_names_and_missing_tips_are_told():
    grasps = torch.eye(4).repeat(2, 1, 1)
    with pytest.raises(ConfigError, match=r"source='grasp_net' is no convention; there are graspnet.*did you mean"):
        convert_grasps(grasps, source="grasp_net", target="m2t2")
    with pytest.raises(ConfigError, match=r"every grasp of source has its own distance .*; give source_tips"):
        convert_grasps(grasps, source="graspnet", target="m2t2")
    with pytest.raises(ShapeError, match=r"source_tips must be one number or \(2,\)"):
        convert_grasps(grasps, source="graspnet", target="m2t2", source_tips=torch.zeros(3))
    with pytest.raises(ConfigError, match=r"source must be a name of GRASP_CONVENTIONS, .* got None"):
        convert_grasps(grasps, source=None, target="m2t2")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="must have two axes"):
        convert_grasps(grasps, source=GraspConvention("x", "x", 0.0), target="m2t2")
    assert convert_grasps(grasps[:0], source=PANDA, target="graspnet", target_tips=0.02).shape == (0, 4, 4)
    assert torch.equal(convert_grasps(grasps, source=PANDA, target="contact_graspnet"), grasps.double())


def test_tips_in_millimetres_are_refused():
    grasps = torch.eye(4, dtype=torch.float64)[None]
    with pytest.raises(ConfigError, match=r"target_tips must be finite metres, at most 2; are they in millimetres\?"):
        convert_grasps(grasps, source="contact_graspnet", target="graspnet", target_tips=20.0)
