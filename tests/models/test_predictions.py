"""to_source and to_frame: what was placed on a changed cloud comes back to where it was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pcdata.datasets import collate_fixed, collate_padded
from pcdata.errors import DTypeError, FrameError, NonFiniteError, PoseError, ShapeError
from pcdata.geometry import rigid
from pcdata.models import preset, to_frame, to_source
from pcdata.rng import seeded
from pcdata.structures import PointCloud
from pcdata.transforms import (
    Compose,
    CropWorkspace,
    NormalizeUnitSphere,
    NormalizeWorkspace,
    RandomFlip,
    RandomRotation,
)
from tests.factories import cloud_in_base
from tests.models.captures import capture, correct_batch

BOX = {"frame": "base", "lower": (-0.15, -0.15, -0.01), "upper": (0.15, 0.15, 0.2)}
CHANGES = Compose([CropWorkspace(**BOX), NormalizeUnitSphere(), RandomRotation(axis=None)])


def random_poses(*shape: int, seed: int = 0) -> torch.Tensor:
    generator = seeded(seed)
    rotation = rigid.rotation_from_quaternion(torch.randn(*shape, 4, generator=generator, dtype=torch.float64))
    return rigid.from_rotation_translation(rotation, torch.rand(*shape, 3, generator=generator).double() - 0.5)


def changed() -> tuple[PointCloud, torch.Tensor]:
    """A normalized, rotated, cropped batch, and (B, 4, 4) cloud_from_base made of its recorded steps alone."""
    cloud = CHANGES(cloud_in_base((120, 90, 150)), generator=seeded(5))
    matrices = []
    for steps in cloud.history:
        matrix = torch.eye(4, dtype=torch.float64)
        for step in steps[-2:]:
            matrix = torch.tensor(step["params"]["matrix"], dtype=torch.float64) @ matrix
        matrices.append(matrix)
    return cloud, torch.stack(matrices)


def test_poses_on_a_normalized_rotated_cropped_cloud_come_back_to_the_base():
    cloud, cloud_from_base = changed()
    in_base = random_poses(3, 7)
    scale = torch.linalg.det(cloud_from_base[:, :3, :3]) ** (1 / 3)
    on_cloud = cloud_from_base[:, None] @ in_base
    on_cloud[..., :3, :3] /= scale[:, None, None, None]
    assert float((scale - 1).abs().min()) > 1  # it really is scaled
    back = to_frame(cloud, "base", poses=on_cloud, points=on_cloud[..., :3, 3])
    assert back.frame_id == "base"
    assert float((back.poses - in_base).abs().max()) < 1e-5
    assert float((back.points - in_base[..., :3, 3]).abs().max()) < 1e-5


def test_graspnet_rows_come_back_with_their_widths():
    cloud, cloud_from_base = changed()
    in_base = random_poses(3, 4)
    scale = torch.linalg.det(cloud_from_base[:, :3, :3]) ** (1 / 3)
    moved = cloud_from_base[:, None] @ in_base
    rotation = moved[..., :3, :3] / scale[:, None, None, None]
    size = torch.tensor([0.08, 0.02, 0.03], dtype=torch.float64).expand(3, 4, 3)
    tail = torch.full((3, 4, 1), 5.0)
    rows = torch.cat(
        [torch.full((3, 4, 1), 0.7), size * scale[:, None, None], rotation.flatten(-2), moved[..., :3, 3], tail], dim=-1
    )
    back = to_frame(cloud, "base", grasps=rows).grasps
    wanted = torch.cat([rows[..., :1], size, in_base[..., :3, :3].flatten(-2), in_base[..., :3, 3], tail], dim=-1)
    assert float((back - wanted).abs().max()) < 1e-5


def test_directions_turn_and_keep_unit_length():
    cloud, cloud_from_base = changed()
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    on_cloud = (cloud_from_base[:, :3, :3] @ up)[:, None]
    back = to_frame(cloud, "base", directions=on_cloud).directions
    assert float((back - up).abs().max()) < 1e-9


def test_grasps_in_the_camera_frame_go_to_the_base_in_one_call():
    batch = correct_batch("contact_graspnet")
    base_from_camera = capture().world_from_camera
    in_camera = random_poses(2, 5)
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
    seen = half_turn @ in_camera
    # The network sees its own points centered: their mean is what was subtracted.
    mean = torch.linalg.inv(batch.source_from_cloud)[:, :3, 3]
    seen[..., :3, 3] += mean[:, None]
    wanted = base_from_camera @ in_camera
    for given in ({}, {"frame_from_source": base_from_camera[0]}):
        assert float((to_frame(batch, "base", poses=seen, **given).poses - wanted).abs().max()) < 1e-5
    assert float((to_source(batch, poses=seen).poses - in_camera).abs().max()) < 1e-5
    assert to_source(batch, poses=seen).frame_id == "camera"


def test_a_mirrored_cloud_is_refused():
    cloud = RandomFlip(probability=(1.0, 0.0, 0.0))(cloud_in_base((50,)), generator=seeded(0))
    for given in ({"poses": random_poses(1, 2)}, {"directions": torch.rand(1, 2, 3)}):
        with pytest.raises(PoseError, match="mirror"):
            to_source(cloud, **given)
    assert to_source(cloud, points=torch.rand(1, 2, 3)).points is not None


def test_axes_scaled_differently_are_refused_for_poses():
    cloud = NormalizeWorkspace(**BOX)(CropWorkspace(**BOX)(cloud_in_base((120,))))
    with pytest.raises(PoseError, match="scales the axes differently"):
        to_source(cloud, poses=random_poses(1, 2))


def test_a_batch_of_another_size_and_unknown_frames_are_refused():
    cloud = cloud_in_base((50, 60))
    with pytest.raises(ShapeError, match="batch of 2 clouds"):
        to_source(cloud, points=torch.rand(3, 5, 3))
    with pytest.raises(FrameError, match="give frame_from_source"):
        to_frame(cloud, "gripper", points=torch.rand(2, 5, 3))
    with pytest.raises(PoseError):
        to_frame(cloud, "base", points=torch.rand(2, 5, 3), frame_from_source=torch.eye(4) * 2)
    bare = replace(correct_batch("graspnet_baseline"), source_from_cloud=None)
    with pytest.raises(FrameError, match="where it came from"):
        to_source(bare, points=torch.rand(2, 5, 3))


def test_one_cloud_needs_no_batch_axis():
    made = preset("graspnet_baseline")
    batch = made.collate([made.pipeline(capture(), generator=seeded(0))])
    assert to_source(batch, points=torch.rand(5, 3)).points.shape == (1, 5, 3)


@pytest.mark.parametrize("given", [[1, 2, 3], "a", np.zeros((5, 3)), torch.zeros(5, 3, dtype=torch.bool)])
@pytest.mark.parametrize("name", ["points", "poses", "grasps", "directions"])
def test_what_is_no_tensor_of_numbers_is_refused_by_name(name, given):
    with pytest.raises(DTypeError, match=f"{name} must be a tensor of real numbers, got"):
        to_source(cloud_in_base((50,)), **{name: given})


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
@pytest.mark.parametrize(
    ("name", "whole"),
    [
        ("points", torch.rand(2, 6, 3)),
        ("poses", random_poses(2, 6)),
        ("grasps", torch.rand(2, 6, 17)),
        ("directions", torch.rand(2, 6, 3) + 0.1),
    ],
)
def test_predictions_that_are_not_finite_are_refused_with_which_and_how_many(name, whole, bad):
    broken = whole.clone()
    broken[1, 2].view(-1)[0] = broken[1, 5].view(-1)[1] = bad
    with pytest.raises(NonFiniteError, match=rf"{name}: 2 of 12 have NaN or infinite .*\(1, 2\) \(cloud, number\)"):
        to_source(cloud_in_base((50, 60)), **{name: broken})


def test_directions_without_a_length_are_refused_and_short_ones_come_back_with_length_one():
    cloud, _ = changed()
    directions = torch.tensor([[0.0, 0.0, 2.0], [0.0, 1e-30, 0.0]], dtype=torch.float64).expand(3, 2, 3)
    back = to_frame(cloud, "base", directions=directions).directions
    assert torch.allclose(back.norm(dim=-1), torch.ones(3, 2, dtype=torch.float64))
    with pytest.raises(PoseError, match="directions: 3 of 6 have the length 0"):
        to_source(cloud, directions=directions * torch.tensor([[1.0], [0.0]]))


def test_axes_scaled_differently_part_tangents_and_normals_so_directions_are_refused():
    cloud = NormalizeWorkspace(**BOX)(CropWorkspace(**BOX)(cloud_in_base((120,))))
    linear = cloud.source_from_cloud[0, :3, :3]
    slanted = torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)
    tangent, normal = linear @ slanted, torch.linalg.inv(linear).T @ slanted
    assert float(rigid.angle_between(tangent, normal)) > 0.1  # one vector, two images
    for given in ({"directions": slanted.expand(1, 2, 3)}, {"grasps": grasp_rows(1, 2)}):
        with pytest.raises(PoseError, match=r"scaled differently|scales the axes differently"):
            to_source(cloud, **given)
    ends = torch.stack([torch.zeros(3, dtype=torch.float64), slanted])[None]
    moved = to_source(cloud, points=ends).points
    assert torch.allclose(moved[0, 1] - moved[0, 0], tangent)


def grasp_rows(*shape: int) -> torch.Tensor:
    poses = random_poses(*shape)
    size = torch.full((*shape, 4), 0.05, dtype=torch.float64)
    return torch.cat([size, poses[..., :3, :3].flatten(-2), poses[..., :3, 3], size[..., :1]], dim=-1)


@pytest.mark.parametrize("counts", [(120, 90, 150), (60, 60, 60)])
def test_predictions_on_padded_clouds_go_back_as_those_on_packed_ones(counts):
    packed = NormalizeUnitSphere()(cloud_in_base(counts))
    collate = collate_fixed if len(set(counts)) == 1 else collate_padded
    padded = collate(packed.unbatch())
    points = torch.rand(3, 7, 3, generator=seeded(0))
    assert padded.source_frame == packed.source_frame
    assert torch.equal(to_source(padded, points=points).points, to_source(packed, points=points).points)
    for frame in packed.frames:
        assert torch.equal(to_frame(padded, frame, points=points).points, to_frame(packed, frame, points=points).points)
    with pytest.raises(FrameError, match="the cloud knows the frames"):
        to_frame(padded, "elsewhere", points=points)
