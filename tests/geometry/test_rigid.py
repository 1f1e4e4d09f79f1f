from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pcdata.errors import PoseError, ShapeError
from pcdata.functional.rows import transform_directions, transform_points
from pcdata.geometry import rigid

angles = st.floats(-math.pi, math.pi)


def random_pose(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    quaternion = torch.randn(4, generator=generator, dtype=torch.float64)
    translation = torch.randn(3, generator=generator, dtype=torch.float64)
    return rigid.from_rotation_translation(rigid.rotation_from_quaternion(quaternion), translation)


def test_rotation_about_z_by_a_right_angle_takes_x_to_y():
    rotation = rigid.rotation_about_axis(torch.tensor([0.0, 0.0, 1.0]), torch.tensor(math.pi / 2))
    x = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(rotation @ x, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), atol=1e-7, rtol=0)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), angles)
def test_rotations_agree_with_scipy(seed, angle):
    transform = pytest.importorskip("scipy.spatial.transform")
    axis = np.random.default_rng(seed).normal(size=3)
    axis /= np.linalg.norm(axis)
    expected = transform.Rotation.from_rotvec(axis * angle)
    ours = rigid.rotation_about_axis(torch.from_numpy(axis), torch.tensor(angle, dtype=torch.float64))
    np.testing.assert_allclose(ours.numpy(), expected.as_matrix(), atol=1e-12)
    from_quaternion = rigid.rotation_from_quaternion(torch.from_numpy(3.0 * expected.as_quat()))
    np.testing.assert_allclose(from_quaternion.numpy(), expected.as_matrix(), atol=1e-12)


def test_a_quaternion_without_length_is_refused():
    with pytest.raises(PoseError, match="length 0"):
        rigid.rotation_from_quaternion(torch.zeros(2, 4))


def test_a_batch_of_clouds_moves_as_each_cloud_alone():
    points = torch.randn(1000, 3)
    matrices = torch.stack([random_pose(seed) for seed in range(3)])
    ptr = torch.tensor([0, 400, 400, 1000])
    moved = transform_points(points, ptr, matrices)
    alone = [
        transform_points(points[a:b], torch.tensor([0, b - a]), matrices[i : i + 1])
        for i, (a, b) in enumerate([(0, 400), (400, 400), (400, 1000)])
    ]
    assert torch.equal(moved, torch.cat(alone))


def test_points_far_away_keep_float32_precision():
    point = torch.tensor([[1e6, -1e6, 1.0]])
    there = random_pose(1)
    back = rigid.invert_rigid(there)
    round_trip = transform_points(point.double(), torch.tensor([0, 1]), (back @ there)[None])
    torch.testing.assert_close(round_trip.float(), point, rtol=2e-7, atol=1e-6)


def test_normals_stay_perpendicular_to_a_sheared_surface():
    shear = torch.eye(4, dtype=torch.float64)
    shear[0, 1] = 0.7
    shear[2, 2] = 3.0
    normal = torch.nn.functional.normalize(torch.randn(1, 3, dtype=torch.float64))
    along = torch.linalg.cross(normal, torch.randn(1, 3, dtype=torch.float64))
    ptr = torch.tensor([0, 1])
    moved_normal = transform_directions(normal, ptr, shear[None])
    moved_along = transform_points(along, ptr, shear[None])
    assert abs(float((moved_normal * moved_along).sum())) < 1e-12
    assert float(moved_normal.norm()) == pytest.approx(1.0)


def test_a_zero_normal_stays_zero():
    moved = transform_directions(torch.zeros(1, 3), torch.tensor([0, 1]), random_pose(0)[None])
    assert torch.equal(moved, torch.zeros(1, 3))


def test_inverse_undoes_a_pose():
    pose = torch.stack([random_pose(seed) for seed in range(4)])
    torch.testing.assert_close(rigid.invert_rigid(pose) @ pose, torch.eye(4, dtype=torch.float64).expand(4, 4, 4))


def test_a_pose_that_is_a_rotation_to_four_digits_only_is_inverted_all_the_same():
    almost = torch.eye(3, dtype=torch.float64) * (1 - 4e-4)
    pose = rigid.from_rotation_translation(almost, torch.tensor([0.3, 2.0, 1.0]))
    rigid.check_rigid("a pose that readers accept", pose)
    torch.testing.assert_close(rigid.invert_rigid(pose) @ pose, torch.eye(4, dtype=torch.float64), rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda pose: pose.index_fill_(0, torch.tensor([0]), torch.nan), "NaN"),
        (lambda pose: pose[:3, :3].mul_(1.1), "not rigid"),
        (lambda pose: pose[:3, 0].neg_(), "mirror"),
        (lambda pose: pose[3, 0].fill_(0.5), "last row"),
    ],
)
def test_a_spoiled_pose_is_refused_with_its_fault(spoil, message):
    pose = random_pose(3)
    rigid.check_rigid("here", pose)
    spoil(pose)
    with pytest.raises(PoseError, match=f"here.*{message}"):
        rigid.check_rigid("here", pose)


def test_a_pose_of_the_wrong_shape_is_refused():
    with pytest.raises(ShapeError, match=r"\(3, 4\)"):
        rigid.check_rigid("here", torch.zeros(3, 4))


def test_map_poses_takes_the_scale_out_of_rotations():
    similarity = rigid.scaling(torch.tensor([2.0, 2.0, 2.0])) @ random_pose(5)
    grasp = random_pose(6)
    moved = rigid.map_poses(similarity, grasp[None])
    rigid.check_rigid("moved", moved)
    torch.testing.assert_close(moved[0, :3, 3], (similarity @ grasp)[:3, 3])


@pytest.mark.parametrize(
    ("factors", "message"), [([1.0, 1.0, -1.0], "mirror"), ([1.0, 1.0, 2.0], "scales the axes differently")]
)
def test_map_poses_refuses_what_no_gripper_can_follow(factors, message):
    with pytest.raises(PoseError, match=message):
        rigid.map_poses(rigid.scaling(torch.tensor(factors)), random_pose(0)[None])


@settings(max_examples=25, deadline=None)
@given(st.sampled_from([0.0, 1e-9, 1e-4, 1.0, math.pi / 2, math.pi - 1e-6, math.pi]))
def test_angles_are_exact_where_a_cosine_is_blind(angle):
    a = torch.tensor([3.0, 0.0, 0.0])
    b = torch.tensor([math.cos(angle), math.sin(angle), 0.0], dtype=torch.float64)
    assert float(rigid.angle_between(a, b)) == pytest.approx(angle, abs=1e-15, rel=1e-9)
