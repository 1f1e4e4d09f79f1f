"""Rigid motions and affine maps as 4x4 matrices that act on column vectors: ``p_to = to_from @ p_from``."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.contracts.on_host import on_host
from pcdata.errors import PoseError, ShapeError
from pcdata.geometry.rotations import rotation_from_unit_quaternion

_FEW = 6  # matrices that are looked at sooner one by one than all at once


def from_rotation_translation(rotation: Tensor, translation: Tensor) -> Tensor:
    """Assemble (..., 4, 4) float64 from (..., 3, 3) and (..., 3)."""
    shape = rotation.shape[:-2]
    if translation.shape[:-1] != shape:
        # Not torch.broadcast_shapes: its first call loads sympy, which takes most of a second.
        shape = torch.broadcast_tensors(rotation[..., 0, 0], translation[..., 0])[0].shape
    if _is_plain(rotation) and _is_plain(translation):
        filled = np.zeros((*shape, 4, 4))  # in a third of the time
        filled[..., :3, :3], filled[..., :3, 3], filled[..., 3, 3] = rotation.numpy(), translation.numpy(), 1.0
        return torch.from_numpy(filled)
    matrix = torch.zeros((*shape, 4, 4), dtype=torch.float64, device=rotation.device)
    matrix[..., :3, :3] = rotation
    matrix[..., :3, 3] = translation
    matrix[..., 3, 3] = 1.0
    return matrix


def _is_plain(tensor: Tensor) -> bool:
    return tensor.is_cpu and tensor.dtype is torch.float64 and type(tensor) is Tensor and not tensor.requires_grad


def scaling(factors: Tensor) -> Tensor:
    """Return (..., 4, 4) float64 matrices that scale by (..., 3) factors about the origin."""
    return from_rotation_translation(torch.diag_embed(factors.double()), torch.zeros_like(factors))


def rotation_about_axis(axis: Tensor, angle: Tensor) -> Tensor:
    """Return (..., 3, 3) float64 rotations by ``angle`` (...,) radians about unit ``axis`` (..., 3), right-handed.

    Source: Rodrigues' formula.
    """
    axis, angle = axis.double(), angle.double()
    x, y, z = axis.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*axis.shape[:-1], 3, 3)
    sine, cosine = angle.sin()[..., None, None], angle.cos()[..., None, None]
    identity = torch.eye(3, dtype=torch.float64, device=axis.device)
    return identity + sine * cross + (1 - cosine) * (cross @ cross)


def rotation_from_quaternion(quaternion: Tensor) -> Tensor:
    """Return (..., 3, 3) float64 rotations from (..., 4) quaternions in (x, y, z, w) order, normalized first.

    Raises:
        PoseError: a quaternion of length 0, or not finite.
    """
    length = quaternion.double().norm(dim=-1, keepdim=True)
    if not bool(((length > 0) & torch.isfinite(length)).all()):
        raise PoseError("rotation_from_quaternion: a quaternion has length 0 or is not finite")
    return rotation_from_unit_quaternion((quaternion.double() / length).roll(1, dims=-1))  # to (w, x, y, z)


def check_rigid(where: str, pose: Tensor, *, tolerance: float = 1e-3) -> None:
    """Require finite (..., 4, 4) matrices with an orthonormal, right-handed rotation and last row 0 0 0 1.

    Raises:
        ShapeError: the shape is not (..., 4, 4).
        PoseError: any other fault, with what was found.
    """
    if pose.shape[-2:] != (4, 4):
        raise ShapeError(f"{where}: a pose must be (..., 4, 4), got {tuple(pose.shape)}")
    if pose.ndim == 3 and are_few_and_rigid(pose, tolerance=tolerance):
        return
    flat = on_host(pose).double().reshape(-1, 4, 4)
    rotation, last = flat[:, :3, :3], flat[:, 3]
    eye = torch.eye(4, dtype=torch.float64, device=flat.device)
    error = (rotation @ rotation.mT - eye[:3, :3]).abs().amax((1, 2))
    mirrored, off = torch.linalg.det(rotation) < 0, (last - eye[3]).abs().amax(1)
    finite = flat.isfinite().flatten(1).all(1)  # a translation enters into none of the comparisons
    wrong = ~finite | (error > tolerance) | mirrored | (off > 1e-6)
    for index in wrong.nonzero().squeeze(1).tolist():
        name = f"{where}: pose {index}" if len(flat) > 1 else f"{where}: the pose"
        matrix = flat[index]
        if not bool(torch.isfinite(matrix).all()):
            raise PoseError(f"{name} has NaN or infinite values (tracking lost?); drop this frame")
        if float(error[index]) > tolerance:
            raise PoseError(
                f"{name} is not rigid: R R^T differs from the identity by {float(error[index]):.2g} (at most "
                f"{tolerance:g}); is there a scale in it, or is it transposed or truncated?"
            )
        if bool(mirrored[index]):
            raise PoseError(f"{name} is a mirror (determinant -1), not a rotation; check the axis convention")
        raise PoseError(f"{name} must have the last row 0 0 0 1, got {matrix[3].tolist()}; is it transposed?")


def are_few_and_rigid(matrices: Tensor, *, tolerance: float) -> bool:
    """Say whether (B, 4, 4) matrices are rotations and translations, for few and in microseconds.

    False may also mean that it takes a closer look.
    """
    if matrices.shape[0] > _FEW or not _is_plain(matrices):
        return False
    # Entries of R R^T and of R^T R are off those of the identity by at most three times as much as each other.
    limit = tolerance / 3
    for (a, b, c, x), (d, e, f, y), (g, h, i, z), last in matrices.tolist():
        off = max(
            *(abs(a * a + b * b + c * c - 1.0), abs(d * d + e * e + f * f - 1.0), abs(g * g + h * h + i * i - 1.0)),
            *(abs(a * d + b * e + c * f), abs(a * g + b * h + c * i), abs(d * g + e * h + f * i)),
        )
        is_turn = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0.0
        # Where an entry is NaN, so is the product that says whether it is a turn: then it is none.
        if not (off <= limit and is_turn and math.isfinite(x + y + z) and last == [0.0, 0.0, 0.0, 1.0]):
            return False
    return True


def check_affine(where: str, matrix: Tensor) -> None:
    """Require finite (B, 4, 4) matrices with last row 0 0 0 1 and a linear part that can be undone.

    A matrix made for row vectors has its translation in the last row, and would move nothing.

    Raises:
        PoseError: another matrix, with what was found.
    """
    if len(matrix) > _FEW and _is_plain(matrix) and _all_affine(matrix.numpy()):
        return
    rows = on_host(matrix).tolist()
    for index, ((a, b, c, _), (d, e, f, _), (g, h, i, _), last) in enumerate(rows):
        name = f"{where}: matrix {index}" if len(rows) > 1 else f"{where}: the matrix"
        if not math.isfinite(sum(map(sum, rows[index]))):
            raise PoseError(f"{name} has NaN or infinite values")
        if max(abs(last[0]), abs(last[1]), abs(last[2]), abs(last[3] - 1.0)) > 1e-6:
            raise PoseError(
                f"{name} must have the last row 0 0 0 1, got {last}; one that is made for row vectors (x @ M, as "
                "PyTorch3D's) is to be transposed, and a projective one moves no cloud"
            )
        if a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) == 0.0:
            raise PoseError(f"{name} is singular: it makes the cloud flat, and nothing leads back to the source")


def _all_affine(rows: NDArray[np.float64]) -> bool:
    """Say whether many matrices are what :func:`check_affine` requires; it tells which one is not."""
    a, b, c, d, e, f, g, h, i = rows[:, :3, :3].reshape(-1, 9).T
    singular = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) == 0.0
    off = np.abs(rows[:, 3] - (0.0, 0.0, 0.0, 1.0)) > 1e-6
    return bool(np.isfinite(rows.sum()) and not off.any() and not singular.any())


def is_rigid(matrix: Tensor, *, tolerance: float = 1e-5) -> bool:
    """Say whether all (..., 4, 4) matrices are rotations and translations, or mirrors: they keep every distance."""
    linear = (matrix if matrix.is_cpu else on_host(matrix))[..., :3, :3].double()
    identity = torch.eye(3, dtype=torch.float64, device="cpu")
    return bool(((linear @ linear.mT - identity).abs() <= tolerance).all())


def invert_rigid(pose: Tensor) -> Tensor:
    """Invert (..., 4, 4) rigid poses.

    The inverse of what is there, not the transpose: recorded rotations are orthonormal to a few digits only, and 1e-4
    off moves a point at 2 m by 0.2 mm on the way there and back.
    """
    rotation = torch.linalg.inv_ex(pose[..., :3, :3]).inverse  # unlike inv, it does not make a GPU wait
    return from_rotation_translation(rotation, -(rotation @ pose[..., :3, 3:]).squeeze(-1))


def map_poses(matrix: Tensor, poses: Tensor) -> Tensor:
    """Move rigid (..., 4, 4) poses (grasps, objects) by a similarity (4,4): the scale moves positions, not rotations.

    Raises:
        PoseError: the matrix mirrors (a mirrored gripper is not a gripper) or scales axes differently.
    """
    matrix = matrix.double()
    linear = matrix[..., :3, :3]
    determinant = torch.linalg.det(linear)
    if bool((determinant <= 0).any()):
        raise PoseError("map_poses: the matrix mirrors (determinant <= 0); a mirrored pose does not exist")
    scale = determinant ** (1.0 / 3.0)
    rotation = linear / scale[..., None, None]
    identity = torch.eye(3, dtype=torch.float64, device=matrix.device)
    if float((rotation @ rotation.mT - identity).abs().max()) > 1e-6:
        raise PoseError("map_poses: the matrix scales the axes differently, so rotations have no image under it")
    moved = matrix @ poses.double()
    return from_rotation_translation(rotation @ poses[..., :3, :3].double(), moved[..., :3, 3])


def angle_between(a: Tensor, b: Tensor) -> Tensor:
    """Return the (...,) angle in radians between vectors (..., 3), exact near 0 and pi."""
    a, b = a.double(), b.double()
    cross = torch.linalg.cross(*torch.broadcast_tensors(a, b), dim=-1).norm(dim=-1)
    return torch.atan2(cross, (a * b).sum(-1)).clamp(0.0, math.pi)
