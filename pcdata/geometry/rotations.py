"""Rotations written as quaternions, as two vectors (6D), as rotation vectors and as Euler angles; all in float64.

Quaternions are (w, x, y, z) here; those that files hold in another order are turned around where they are read.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.errors import ConfigError


def quaternion_from_rotation(rotation: Tensor) -> Tensor:
    """Return (..., 4) unit quaternions (w, x, y, z), w >= 0, of (..., 3, 3) rotations; exact near half turns too.

    Source: Shepperd, Quaternion from rotation matrix, 1978: divide by the largest of the four components.
    """
    r = rotation.double()
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in r.unbind(-2))
    # Row k is the quaternion times four times its component k.
    candidates = torch.stack(
        [
            torch.stack([1 + a + e + i, h - f, c - g, d - b], dim=-1),
            torch.stack([h - f, 1 + a - e - i, b + d, c + g], dim=-1),
            torch.stack([c - g, b + d, 1 - a + e - i, f + h], dim=-1),
            torch.stack([d - b, c + g, f + h, 1 - a - e + i], dim=-1),
        ],
        dim=-2,
    )
    largest = candidates.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    chosen = candidates.gather(-2, largest[..., None, None].expand(*largest.shape, 1, 4)).squeeze(-2)
    return _nonnegative(chosen / chosen.norm(dim=-1, keepdim=True))


def rotation_from_quaternion(quaternion: Tensor) -> Tensor:
    """Return (..., 3, 3) rotations of (..., 4) quaternions (w, x, y, z) of any length but 0."""
    q = quaternion.double()
    return rotation_from_unit_quaternion(q / q.norm(dim=-1, keepdim=True))


def rotation_from_unit_quaternion(unit: Tensor) -> Tensor:
    """Return (..., 3, 3) rotations of (..., 4) float64 quaternions (w, x, y, z) of length 1, which is not checked."""
    w, x, y, z = unit.unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(*unit.shape[:-1], 3, 3)


def multiplied(first: Tensor, second: Tensor) -> Tensor:
    """Return the product of (..., 4) quaternions (w, x, y, z): the rotation ``second``, then ``first``."""
    first, second = torch.broadcast_tensors(first.double(), second.double())
    w, v = first[..., :1], first[..., 1:]
    s, u = second[..., :1], second[..., 1:]
    real = w * s - (v * u).sum(-1, keepdim=True)
    return torch.cat([real, w * u + s * v + torch.linalg.cross(v, u, dim=-1)], dim=-1)


def quaternion_from_rotation_vector(vector: Tensor) -> Tensor:
    """Return (..., 4) unit quaternions (w, x, y, z) of (..., 3) axes times angles in radians; exact near 0."""
    vector = vector.double()
    half = vector.norm(dim=-1, keepdim=True) / 2
    return torch.cat([half.cos(), 0.5 * torch.sinc(half / torch.pi) * vector], dim=-1)


def rotation_vector_from_quaternion(quaternion: Tensor) -> Tensor:
    """Return (..., 3) axes times angles of at most half a turn, of (..., 4) unit quaternions; exact near 0 and pi."""
    w, *_ = (quaternion := _nonnegative(quaternion.double())).unbind(-1)
    v = quaternion[..., 1:]
    sine = v.norm(dim=-1)
    factor = torch.where(sine > 0, 2 * torch.atan2(sine, w) / torch.where(sine > 0, sine, 1.0), 2.0)
    return factor[..., None] * v


def rotation_from_two_vectors(first: Tensor, second: Tensor) -> Tensor:
    """Return (..., 3, 3) rotations with the given first two columns (..., 3), made orthonormal in this order.

    Source: Zhou et al., On the continuity of rotation representations in neural networks, CVPR 2019, section 4.
    """
    first, second = first.double(), second.double()
    x = first / first.norm(dim=-1, keepdim=True)
    y = second - (x * second).sum(-1, keepdim=True) * x
    y = y / y.norm(dim=-1, keepdim=True)
    return torch.stack([x, y, torch.linalg.cross(x, y, dim=-1)], dim=-1)


def _fixed_axes(axes: str) -> tuple[list[int], bool]:
    """Return the order of fixed axes, and whether the angles are to be taken from last to first."""
    if sorted(axes.lower()) != ["x", "y", "z"] or axes not in (axes.lower(), axes.upper()):
        raise ConfigError(
            f"euler angles: axes must be an order of 'xyz' (fixed) or of 'XYZ' (axes that move along), got {axes!r}"
        )
    moving = axes.isupper()
    return ["xyz".index(axis) for axis in (axes.lower()[::-1] if moving else axes)], moving


def rotation_from_euler(angles: Tensor, axes: str) -> Tensor:
    """Return (..., 3, 3) rotations of (..., 3) angles in radians about three axes, one after the other.

    Small letters are fixed axes: with "xyz" the first angle turns about x, the next about y, the last about z. Capitals
    are axes that move along, as in SciPy: "XYZ" is "zyx" with the angles from last to first.

    Raises:
        ConfigError: axes that are no such order.
    """
    order, moving = _fixed_axes(axes)
    unit = torch.eye(3, dtype=torch.float64, device=angles.device)
    turns = [
        quaternion_from_rotation_vector(angle[..., None] * unit[axis])
        for axis, angle in zip(order, (angles.flip(-1) if moving else angles).double().unbind(-1), strict=True)
    ]
    return rotation_from_unit_quaternion(multiplied(turns[2], multiplied(turns[1], turns[0])))


def euler_from_rotation(rotation: Tensor, axes: str) -> Tensor:
    """Return (..., 3) angles of (..., 3, 3) rotations as :func:`rotation_from_euler` takes them.

    The middle one is at most a quarter turn. Where it is one, the other two are not unique; they give the rotation too,
    since the last is read off what the first two leave of it.

    Raises:
        ConfigError: axes that are no order of them.
    """
    (i, j, k), moving = _fixed_axes(axes)
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    r = rotation.double()
    middle = torch.atan2(-sign * r[..., k, i], torch.hypot(r[..., i, i], r[..., j, i]))
    first = torch.atan2(sign * r[..., k, j], r[..., k, k])
    column = first.cos()[..., None] * r[..., :, j] - sign * first.sin()[..., None] * r[..., :, k]
    last = torch.atan2(-sign * column[..., i], column[..., j])
    angles = torch.stack([first, middle, last], dim=-1)
    return angles.flip(-1) if moving else angles


def closest_rotation(linear: Tensor) -> Tensor:
    """Return the orthogonal (..., 3, 3) matrices nearest to invertible ones: their polar factors.

    Scale, the same on every axis or not, is taken out; that of a matrix that mirrors is a mirror, determinant -1.

    Source: Higham, Computing the polar decomposition - with applications, 1986.
    """
    left, _, right = torch.linalg.svd(linear.double())
    return left @ right


def slerp(first: Tensor, second: Tensor, share: Tensor | float) -> Tensor:
    """Return the (..., 4) unit quaternions at a share of the shorter way from one rotation to another, at even speed.

    Source: Shoemake, Animating rotation with quaternion curves, SIGGRAPH 1985.
    """
    first, second = torch.broadcast_tensors(first.double(), second.double())
    first, second = (one / one.norm(dim=-1, keepdim=True) for one in (first, second))
    way = multiplied(second, first * first.new_tensor([1.0, -1.0, -1.0, -1.0]))
    share = torch.as_tensor(share, dtype=torch.float64, device=first.device)[..., None]
    part = quaternion_from_rotation_vector(share * rotation_vector_from_quaternion(_nonnegative(way)))
    return multiplied(part, first)


def mean_rotation(rotation: Tensor, weights: Tensor | None = None) -> Tensor:
    """Return the (..., 3, 3) rotation nearest to (..., N, 3, 3) rotations: least weighted squares of the matrices.

    Args:
        rotation: one or more.
        weights: (..., N), not negative; None = all alike.

    Raises:
        ConfigError: there are none, or weights that are negative or all 0.

    Source: Markley et al., Averaging quaternions, Journal of Guidance, Control, and Dynamics 30(4), 2007.
    """
    quaternion = quaternion_from_rotation(rotation)
    given = quaternion.new_ones(()) if weights is None else weights.double()
    share = given.expand(quaternion.shape[:-1])
    if not share.shape[-1] or bool((share < 0).any()) or not bool((share.sum(-1) > 0).all()):
        raise ConfigError("mean_rotation: needs rotations and weights from 0 on, of which some are above 0")
    spread = torch.einsum("...n,...ni,...nj->...ij", share, quaternion, quaternion)
    return rotation_from_unit_quaternion(_nonnegative(torch.linalg.eigh(spread).eigenvectors[..., -1]))


def nearest_sign(quaternion: Tensor, before: Tensor) -> Tensor:
    """Return (..., 4) quaternions of the same rotations in the sign that is nearest to others; a tie keeps its sign."""
    return torch.where((quaternion * before).sum(-1, keepdim=True) < 0, -quaternion, quaternion)


def _nonnegative(quaternion: Tensor) -> Tensor:
    """Return the one of q and -q whose first component that is not 0 is positive."""
    sign = quaternion.sign()
    first = sign.gather(-1, sign.abs().argmax(dim=-1, keepdim=True))  # argmax gives the first of equals
    return torch.where(first < 0, -quaternion, quaternion)
