"""Rotations in every notation against SciPy, at rest, at half turns and a hair beside them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from pcdata.errors import ConfigError
from pcdata.geometry import rotations

ANGLES = (0.0, 1e-300, 1e-12, 1e-8, 1e-4, 1.0, math.pi - 1e-4, math.pi - 1e-8, math.pi - 1e-12, math.pi)


def some_rotations() -> Rotation:
    axes = Rotation.random(20, random_state=3).apply([1.0, 0.0, 0.0])
    axes = np.concatenate([axes, np.eye(3), -np.eye(3), [[0.6, 0.8, 0.0]]])
    return Rotation.from_rotvec(np.concatenate([angle * axes for angle in ANGLES]))


@pytest.fixture(scope="module")
def known() -> Rotation:
    return some_rotations()


def matrices(rotation: Rotation) -> torch.Tensor:
    return torch.from_numpy(rotation.as_matrix())


def same(actual: torch.Tensor, expected: torch.Tensor) -> None:
    torch.testing.assert_close(actual, expected, atol=1e-15 * 8, rtol=0)


def test_quaternions_and_matrices_are_those_of_scipy(known):
    quaternion = rotations.quaternion_from_rotation(matrices(known))
    assert bool((quaternion[:, 0] >= 0).all())
    same(rotations.rotation_from_quaternion(quaternion), matrices(known))
    xyzw = torch.from_numpy(known.as_quat())
    same(rotations.rotation_from_quaternion(3.0 * xyzw.roll(1, -1)), matrices(known))


def test_a_product_is_one_rotation_after_the_other(known):
    other = Rotation.random(len(known), random_state=5)
    wxyz = [rotations.quaternion_from_rotation(matrices(one)) for one in (known, other)]
    same(rotations.rotation_from_quaternion(rotations.multiplied(*wxyz)), matrices(known * other))


def test_rotation_vectors_are_exact_at_rest_and_at_half_turns(known):
    vector = torch.from_numpy(known.as_rotvec())
    quaternion = rotations.quaternion_from_rotation_vector(vector)
    same(rotations.rotation_from_quaternion(quaternion), matrices(known))
    back = rotations.rotation_vector_from_quaternion(quaternion)
    assert float(back.norm(dim=-1).max()) <= math.pi + 1e-15
    same(rotations.rotation_from_quaternion(rotations.quaternion_from_rotation_vector(back)), matrices(known))
    below = vector.norm(dim=-1) < 3.1
    torch.testing.assert_close(back[below], vector[below], atol=0, rtol=1e-14)


def test_small_rotation_vectors_keep_every_digit():
    vector = torch.tensor([[1e-9, 0, 0], [0, 3e-20, 1e-20], [0, 0, 0]], dtype=torch.float64)
    back = rotations.rotation_vector_from_quaternion(rotations.quaternion_from_rotation_vector(vector))
    torch.testing.assert_close(back, vector, atol=0, rtol=1e-15)


def test_two_vectors_are_made_orthonormal_in_their_order(known):
    turned = matrices(known)
    first, second = turned[..., 0], turned[..., 1]
    same(rotations.rotation_from_two_vectors(first, second), turned)
    same(rotations.rotation_from_two_vectors(2.0 * first, 0.3 * second + 5.0 * first), turned)


def test_the_closest_rotation_takes_scales_out_and_keeps_mirrors(known):
    turned = matrices(known)
    stretch = torch.diag(torch.tensor([0.5, 2.0, 3.0], dtype=torch.float64))
    other = matrices(Rotation.random(len(known), random_state=7))
    # A symmetric positive stretch, before or after: its polar factor is the rotation alone.
    spread = other @ stretch @ other.mT
    for linear in (turned @ spread, spread @ turned, 7.0 * turned):
        torch.testing.assert_close(rotations.closest_rotation(linear), turned, atol=1e-14, rtol=0)
    mirror = torch.diag(torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64))
    torch.testing.assert_close(rotations.closest_rotation(2.0 * turned @ mirror), turned @ mirror, atol=1e-14, rtol=0)


@pytest.mark.parametrize("axes", ["xyz", "yxz", "zyx", "XYZ", "ZXY", "ZYX"])
def test_euler_angles_about_fixed_and_moving_axes_are_those_of_scipy(axes):
    rotation = Rotation.random(20, random_state=4)
    angles = torch.from_numpy(rotation.as_euler(axes))
    same(rotations.rotation_from_euler(angles, axes), matrices(rotation))
    torch.testing.assert_close(rotations.euler_from_rotation(matrices(rotation), axes), angles, atol=1e-12, rtol=0)


@pytest.mark.parametrize("axes", ["xyx", "xy", "Xyz", "abc", ""])
def test_an_order_of_axes_that_is_none_is_refused(axes):
    with pytest.raises(ConfigError, match="axes must be an order of 'xyz'"):
        rotations.rotation_from_euler(torch.zeros(3), axes)
    with pytest.raises(ConfigError, match="axes must be an order of 'xyz'"):
        rotations.euler_from_rotation(torch.eye(3), axes)


def test_between_two_rotations_are_those_of_scipy(known):
    quaternions = rotations.quaternion_from_rotation(matrices(known))
    first, second = known[:-1], known[1:]
    unique = torch.from_numpy((first.inv() * second).magnitude()) < math.pi - 1e-3  # of half a turn there are two ways
    for share in (0.0, 0.2, 0.5, 0.9, 1.0):
        found = rotations.slerp(quaternions[:-1], -3.0 * quaternions[1:], share)
        expected = first * Rotation.from_rotvec(share * (first.inv() * second).as_rotvec())
        found = rotations.rotation_from_quaternion(found)
        torch.testing.assert_close(found[unique], matrices(expected)[unique], atol=1e-7, rtol=0)
    assert int(unique.sum()) > 100


def test_the_mean_rotation_is_that_of_scipy():
    some = Rotation.random(40, random_state=5)
    near = Rotation.from_rotvec(0.4 * some.as_rotvec())
    weights = np.random.default_rng(1).random(40)
    for given in (None, weights):
        found = rotations.mean_rotation(matrices(near), None if given is None else torch.from_numpy(given))
        np.testing.assert_allclose(found.numpy(), near.mean(given).as_matrix(), atol=1e-12)
    both = rotations.mean_rotation(torch.stack([matrices(near), matrices(near).flip(0)]))
    torch.testing.assert_close(both[0], both[1])
    torch.testing.assert_close(rotations.mean_rotation(matrices(near)[:1]), matrices(near)[0])
    for wrong in (-weights, 0 * weights):
        with pytest.raises(ConfigError, match="mean_rotation: needs rotations and weights"):
            rotations.mean_rotation(matrices(near), torch.from_numpy(wrong))
    with pytest.raises(ConfigError, match="needs rotations"):
        rotations.mean_rotation(matrices(near)[:0])
