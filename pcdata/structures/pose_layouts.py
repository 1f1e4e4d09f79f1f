"""How a pose may be written, and what a motion of its cloud does to it: one row per layout.

A new layout is its row in :data:`LAYOUTS`: then clouds move it, keep it and hold it to its rules.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pcdata.geometry import rotations

_AT_REST = 1e-12  # a motion nearer to none than this is what float64 leaves of going there and back
_UNIT = 1e-3  # that a quaternion may be longer or shorter than 1, and a rotation's R R^T off the identity
_DEGENERATE = 1e-6  # sine of the angle between two vectors below which they span no plane


class Motion:
    """What affine (B, 4, 4) float64 matrices do to signals; every part is computed once, when it is first needed."""

    def __init__(self, matrix: Tensor) -> None:
        self.matrix = matrix.double()

    @functools.cached_property
    def rests(self) -> Tensor:
        """(B,) bool: the matrix is the identity, so values stay as they were recorded, bit for bit."""
        identity = torch.eye(4, dtype=torch.float64, device=self.matrix.device)
        return (self.matrix - identity).abs().amax(dim=(-2, -1)) <= _AT_REST

    @functools.cached_property
    def all_rest(self) -> bool:
        """Whether nothing is to be computed; on a GPU that is not asked, as the host would wait for the answer."""
        return self.matrix.device.type == "cpu" and bool(self.rests.all())

    @property
    def linear(self) -> Tensor:
        """(B, 3, 3)."""
        return self.matrix[:, :3, :3]

    @property
    def offset(self) -> Tensor:
        """(B, 3)."""
        return self.matrix[:, :3, 3]

    @functools.cached_property
    def normals(self) -> Tensor:
        """(B, 3, 3): what turns normals of surfaces, but for their length."""
        return torch.linalg.inv(self.linear).mT

    @functools.cached_property
    def rotation(self) -> Tensor:
        """(B, 3, 3): the rotation nearest to the linear part, or the mirror."""
        return rotations.closest_rotation(self.linear)

    @functools.cached_property
    def quaternion(self) -> Tensor:
        """(B, 4) of the rotation, (w, x, y, z), w >= 0: products with it stay near the quaternion that is turned."""
        return rotations.quaternion_from_rotation(self.rotation)

    @functools.cached_property
    def handedness(self) -> Tensor:
        """(B,) 1, or -1 where the matrix mirrors."""
        return torch.linalg.det(self.linear).sign()


def motion_by(matrix: Tensor) -> Motion:
    """Return affine (B, 4, 4) matrices as what they do to signals."""
    return Motion(matrix)


def per_cloud(parts: Tensor, values: Tensor, row: int) -> Tensor:
    """Give (B, ...) parts of a motion the free axes of (B, ..., row) values, whose rows have ``row`` axes."""
    free = values.ndim - 1 - row
    return parts.reshape(len(parts), *[1] * free, *parts.shape[1:])


def applied(linear: Tensor, vectors: Tensor) -> Tensor:
    """Return ``linear @ vector`` of (..., 3, 3) and (..., 3): the same sums for one cloud and for many, bit for bit."""
    x, y, z = vectors[..., 0:1], vectors[..., 1:2], vectors[..., 2:3]
    return (x * linear[..., 0] + y * linear[..., 1]) + z * linear[..., 2]


def _product(a: Tensor, b: Tensor) -> Tensor:
    """Return ``a @ b`` of (..., 3, 3)."""
    return torch.stack([applied(a, b[..., column]) for column in range(3)], dim=-1)


# -- how a pose is written -----------------------------------------------------------------------------------------

Fault = tuple[Tensor, str]  # (B, ...) bool where rows are at fault, and what must hold


@dataclass(frozen=True, kw_only=True)
class PoseLayout:
    """One way to write a rotation: beside a position, x, y, z and then its columns, or both in a 4x4; or alone."""

    row: tuple[int, ...]  # shape of one pose
    holds: str  # in words
    rotation: Callable[[Tensor], Tensor]  # rotation part -> R (..., 3, 3), float64
    written: Callable[[Tensor], Tensor]  # R (..., 3, 3) float64 -> rotation part
    turned: Callable[[Tensor, Tensor, Callable[[], Tensor]], Tensor]  # rotation part, Q, its quaternion (..., 4) -> Q R
    conjugated: Callable[[Tensor, Tensor, Tensor], Tensor]  # rotation part, Q, handedness (..., 1) -> Q R Q^T
    faults: Callable[[Tensor], list[Fault]]  # of rotation parts; of poses that are 4x4, of those
    has_position: bool = True
    is_quaternion: bool = False  # so its rotation part and the opposite one are the same rotation

    @property
    def is_matrix(self) -> bool:
        """Whether its rows are matrices, 4x4 or 3x3."""
        return len(self.row) == 2

    def parts(self, values: Tensor) -> tuple[Tensor | None, Tensor]:
        """Return the positions (..., 3), None where there are none, and the rotation parts."""
        if not self.has_position:
            return None, values
        if self.is_matrix:
            return values[..., :3, 3], values[..., :3, :3]
        return values[..., :3], values[..., 3:]

    def joined(self, values: Tensor, position: Tensor | None, rotation: Tensor) -> Tensor:
        """Return the poses with other positions and rotation parts."""
        if position is None:
            return rotation
        if not self.is_matrix:
            return torch.cat([position, rotation], dim=-1)
        top = torch.cat([rotation, position[..., None]], dim=-1)
        return torch.cat([top, values[..., 3:, :].expand(*top.shape[:-2], 1, 4)], dim=-2)

    def faults_of(self, values: Tensor) -> list[Fault]:
        """Return what can be wrong with (..., row) float64 poses, and where it is."""
        return self.faults(values if self.is_matrix else self.parts(values)[1])


Ways = dict[str, Callable[..., Tensor | list[Fault]] | bool]


def _by_matrix(rotation: Callable[[Tensor], Tensor], written: Callable[[Tensor], Tensor]) -> Ways:
    """Return how a rotation part is moved by way of its matrix."""

    def turned(part: Tensor, matrix: Tensor, quaternion: Callable[[], Tensor]) -> Tensor:
        return written(_product(matrix, rotation(part)))

    def conjugated(part: Tensor, matrix: Tensor, handedness: Tensor) -> Tensor:
        return written(_product(_product(matrix, rotation(part)), matrix.mT))

    return {"rotation": rotation, "written": written, "turned": turned, "conjugated": conjugated}


def _quaternion(w_last: bool) -> Ways:
    def rotation_of(part: Tensor) -> Tensor:
        return rotations.rotation_from_quaternion(part.roll(1, -1) if w_last else part)

    def turned(part: Tensor, rotation: Tensor, quaternion: Callable[[], Tensor]) -> Tensor:
        if w_last:
            return rotations.multiplied(quaternion(), part.roll(1, -1)).roll(-1, -1)
        return rotations.multiplied(quaternion(), part)

    def conjugated(part: Tensor, rotation: Tensor, handedness: Tensor) -> Tensor:
        w, v = (part[..., 3:], part[..., :3]) if w_last else (part[..., :1], part[..., 1:])
        v = handedness * applied(rotation, v)
        return torch.cat([v, w] if w_last else [w, v], dim=-1)

    def faults(part: Tensor) -> list[Fault]:
        length = part.norm(dim=-1)
        order = "x y z w" if w_last else "w x y z"
        return [
            (length == 0, f"the quaternion has length 0, which is no rotation ({order}); leave the sample out"),
            (
                (length - 1).abs() > _UNIT,
                f"the quaternion ({order}) must have length 1 to {_UNIT:g}: divide it by its length, or is the layout "
                "another one?",
            ),
        ]

    def written(rotation: Tensor) -> Tensor:
        quaternion = rotations.quaternion_from_rotation(rotation)
        return quaternion.roll(-1, -1) if w_last else quaternion

    ways: Ways = {"rotation": rotation_of, "written": written, "turned": turned, "conjugated": conjugated}
    return {**ways, "faults": faults, "is_quaternion": True}


def _two_vectors(rows: bool) -> Ways:
    def matrix(part: Tensor) -> Tensor:
        found = rotations.rotation_from_two_vectors(part[..., :3], part[..., 3:])
        return found.mT if rows else found

    def written(rotation: Tensor) -> Tensor:
        first, second = (rotation if rows else rotation.mT).unbind(-2)[:2]
        return torch.cat([first, second], dim=-1)

    def faults(part: Tensor) -> list[Fault]:
        first, second = part[..., :3], part[..., 3:]
        area = torch.linalg.cross(first, second, dim=-1).norm(dim=-1)
        flat = ~(area > _DEGENERATE * first.norm(dim=-1) * second.norm(dim=-1))
        which = "rows" if rows else "columns"
        return [(flat, f"the two {which} of the rotation must not be 0 nor parallel; leave the sample out")]

    return {**_by_matrix(matrix, written), "faults": faults}


def _euler(order: str, *, intrinsic: bool) -> Ways:
    """Angles in radians, one per column, about the axes that the order names: fixed ones, or ones that turn along."""
    axes = order.upper() if intrinsic else order

    def matrix(part: Tensor) -> Tensor:
        return rotations.rotation_from_euler(part, axes)

    def written(rotation: Tensor) -> Tensor:
        return rotations.euler_from_rotation(rotation, axes)

    return {**_by_matrix(matrix, written), "faults": _no_faults}


def _rotation_vector() -> Ways:
    def matrix(part: Tensor) -> Tensor:
        return rotations.rotation_from_quaternion(rotations.quaternion_from_rotation_vector(part))

    def turned(part: Tensor, rotation: Tensor, quaternion: Callable[[], Tensor]) -> Tensor:
        moved = rotations.multiplied(quaternion(), rotations.quaternion_from_rotation_vector(part))
        return rotations.rotation_vector_from_quaternion(moved)

    def conjugated(part: Tensor, rotation: Tensor, handedness: Tensor) -> Tensor:
        return handedness * applied(rotation, part)

    def written(rotation: Tensor) -> Tensor:
        return rotations.rotation_vector_from_quaternion(rotations.quaternion_from_rotation(rotation))

    return {"rotation": matrix, "written": written, "turned": turned, "conjugated": conjugated, "faults": _no_faults}


def _no_faults(part: Tensor) -> list[Fault]:
    return []


def _rotation_faults(rotation: Tensor) -> list[Fault]:
    identity = torch.eye(3, dtype=torch.float64, device=rotation.device)
    skewed = (_product(rotation, rotation.mT) - identity).abs().amax(dim=(-2, -1)) > _UNIT
    return [
        (skewed, f"the matrix must be rigid, R R^T the identity to {_UNIT:g}; is there a scale in it?"),
        (torch.linalg.det(rotation) < 0, "the matrix is a mirror (determinant -1), not a pose; check the axes"),
    ]


def _pose_faults(pose: Tensor) -> list[Fault]:
    last = pose.new_tensor([0.0, 0.0, 0.0, 1.0])
    return [
        (
            (pose[..., 3, :] - last).abs().amax(dim=-1) > 1e-6,
            "the matrix must have the last row 0 0 0 1; is it transposed?",
        ),
        *_rotation_faults(pose[..., :3, :3]),
    ]


def _same(matrix: Tensor) -> Tensor:
    return matrix


_MATRIX = _by_matrix(lambda part: part.double(), _same)
# Rotations in columns: name, columns, what they are, how they move.
_ROTATIONS: tuple[tuple[str, int, str, Ways], ...] = (
    ("quat_wxyz", 4, "quaternion w x y z", _quaternion(w_last=False)),
    ("quat_xyzw", 4, "quaternion x y z w", _quaternion(w_last=True)),
    ("rot6d_rows", 6, "the first two rows of R", _two_vectors(rows=True)),
    ("rot6d_columns", 6, "the first two columns of R", _two_vectors(rows=False)),
    ("axis_angle", 3, "axis times angle in radians", _rotation_vector()),
    (
        "euler_xyz_fixed",
        3,
        "radians about the fixed axes x, then y, then z (roll pitch yaw; SciPy's xyz)",
        _euler("xyz", intrinsic=False),
    ),
    (
        "euler_xyz_moving",
        3,
        "radians about x, then the y and then the z that turned along (SciPy's XYZ)",
        _euler("xyz", intrinsic=True),
    ),
    (
        "euler_zyx_moving",
        3,
        "radians about z, then the y and then the x that turned along (yaw pitch roll; SciPy's ZYX)",
        _euler("zyx", intrinsic=True),
    ),
)

LAYOUTS = {
    "matrix": PoseLayout(row=(4, 4), holds="the 4x4 frame_from_pose", **_MATRIX, faults=_pose_faults),  # type: ignore[arg-type]
    **{
        f"xyz_{name}": PoseLayout(row=(3 + width,), holds=f"x y z, {holds}", **ways)  # type: ignore[arg-type]
        for name, width, holds, ways in _ROTATIONS
    },
    "rotation": PoseLayout(
        row=(3, 3),
        holds="a rotation alone: the 3x3 R",
        has_position=False,
        **_MATRIX,  # type: ignore[arg-type]
        faults=_rotation_faults,
    ),
    **{
        name: PoseLayout(row=(width,), holds=f"a rotation alone: {holds}", has_position=False, **ways)  # type: ignore[arg-type]
        for name, width, holds, ways in _ROTATIONS
    },
}
