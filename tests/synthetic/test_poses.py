"""Camera poses: where they look, and known errors of the reported ones."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pcdata.geometry import rigid
from pcdata.synthetic import Miscalibration, look_at, tabletop

SMALL = (60, 80)


def _pose_error(truth: Tensor, reported: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation angle in degrees and distance in metres between poses, from the trace and the camera centers."""
    turn = truth[:, :3, :3].mT @ reported[:, :3, :3]
    cosine = (turn.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    return torch.rad2deg(torch.acos(cosine.clamp(-1, 1))), (truth[:, :3, 3] - reported[:, :3, 3]).norm(dim=-1)


def test_look_at_puts_the_target_in_the_middle_and_up_upwards() -> None:
    pose = look_at((0.6, -0.8, 0.9), (0.1, 0.2, 0.05))
    rigid.check_rigid("test", pose)
    target = torch.linalg.inv(pose) @ torch.tensor([0.1, 0.2, 0.05, 1.0]).double()
    torch.testing.assert_close(target[:2], torch.zeros(2).double())
    assert float(target[2]) == pytest.approx(float((pose[:3, 3] - torch.tensor([0.1, 0.2, 0.05])).norm()))
    assert float(pose[2, 0]) == pytest.approx(0.0)  # image x is level
    assert float(pose[2, 1]) < 0  # image y points down


def test_cameras_stand_around_and_above_and_look_at_the_table_center() -> None:
    poses = tabletop(3, num_objects=0, num_views=8, size=(4, 4)).truth.world_from_camera
    rigid.check_rigid("test", poses)
    assert float(poses[:, 2, 3].min()) > 0.4
    position, axis = poses[:, :3, 3], poses[:, :3, 2]
    on_table = position - axis * (position[:, 2:] / axis[:, 2:])
    assert float(on_table[:, :2].norm(dim=-1).max()) < 0.1
    azimuth = torch.atan2(position[:, 1], position[:, 0]).sort().values
    gaps = torch.cat([azimuth.diff(), azimuth[:1] + 2 * torch.pi - azimuth[-1:]])
    assert float(gaps.max()) < torch.pi / 2  # every quarter has a camera


def test_miscalibration_moves_the_reported_poses_by_exactly_the_asked_amounts() -> None:
    asked = Miscalibration(rotation_degrees=(0.0, 1.5, 3.0), translation=(0.0, 0.01, 0.02))
    scene = tabletop(1, num_views=3, size=SMALL, miscalibration=asked)
    assert scene.frame.world_from_camera is not None
    degrees, metres = _pose_error(scene.truth.world_from_camera, scene.frame.world_from_camera)
    torch.testing.assert_close(degrees, torch.tensor([0.0, 1.5, 3.0]).double(), atol=1e-5, rtol=0)
    torch.testing.assert_close(metres, torch.tensor([0.0, 0.01, 0.02], dtype=torch.float64), atol=1e-12, rtol=0)


def test_one_amount_holds_for_every_view_in_directions_of_their_own() -> None:
    scene = tabletop(1, num_views=3, size=SMALL, miscalibration=Miscalibration(translation=0.005))
    assert scene.frame.world_from_camera is not None
    shift = scene.frame.world_from_camera[:, :3, 3] - scene.truth.world_from_camera[:, :3, 3]
    torch.testing.assert_close(shift.norm(dim=-1), torch.full((3,), 0.005).double())
    assert float((shift[0] - shift[1]).norm()) > 1e-4
    assert torch.equal(scene.frame.world_from_camera[:, :3, :3], scene.truth.world_from_camera[:, :3, :3])


def test_miscalibration_changes_the_reported_poses_only() -> None:
    plain = tabletop(1, num_views=2, size=SMALL, noise="stereo")
    wrong = tabletop(1, num_views=2, size=SMALL, noise="stereo", miscalibration=Miscalibration(rotation_degrees=5.0))
    assert plain.frame.world_from_camera is not None
    assert wrong.frame.world_from_camera is not None
    assert not torch.allclose(plain.frame.world_from_camera, wrong.frame.world_from_camera)
    assert torch.equal(plain.truth.world_from_camera, wrong.truth.world_from_camera)
    for name in ("depth", "colors", "labels"):
        assert torch.equal(getattr(plain.frame, name), getattr(wrong.frame, name)), name
