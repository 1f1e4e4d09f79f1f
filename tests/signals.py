"""Signals of every kind whose motion is known: each is attached to a marker that is a point of the world."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pcdata.rng import seeded
from pcdata.structures import PointCloud
from pcdata.structures.pose_layouts import LAYOUTS

HORIZON = 3


def rotations_of(num_clouds: int, *, seed: int = 0) -> Tensor:
    """(B, HORIZON, 3, 3) float64 random rotations."""
    normal = torch.randn(num_clouds, HORIZON, 3, 3, generator=seeded(seed), dtype=torch.float64)
    rotation, _ = torch.linalg.qr(normal)
    return rotation * torch.linalg.det(rotation)[..., None, None]


EULER = {"euler_xyz_fixed": "xyz", "euler_xyz_moving": "XYZ", "euler_zyx_moving": "ZYX"}  # as SciPy calls them


def has_position(layout: str) -> bool:
    """Whether a layout has x, y and z: told by its name."""
    return layout == "matrix" or layout.startswith("xyz_")


def written(layout: str, position: Tensor, rotation: Tensor) -> Tensor:
    """Poses of a layout, float64, from positions and rotations, by SciPy and by plain indexing."""
    from scipy.spatial.transform import Rotation

    free = rotation.shape[:-2]
    turned = Rotation.from_matrix(rotation.reshape(-1, 3, 3).numpy())
    if layout == "matrix":
        pose = torch.eye(4, dtype=torch.float64).repeat(*free, 1, 1)
        pose[..., :3, :3], pose[..., :3, 3] = rotation, position
        return pose
    if layout == "rotation":
        return rotation.clone()
    name = layout.removeprefix("xyz_")
    part = {
        "quat_xyzw": lambda: torch.from_numpy(turned.as_quat()),
        "quat_wxyz": lambda: torch.from_numpy(turned.as_quat()).roll(1, -1),
        "rot6d_rows": lambda: rotation[..., :2, :].flatten(-2),
        "rot6d_columns": lambda: torch.cat([rotation[..., 0], rotation[..., 1]], dim=-1),
        "axis_angle": lambda: torch.from_numpy(turned.as_rotvec()),
        **{euler: lambda order=order: torch.from_numpy(turned.as_euler(order)) for euler, order in EULER.items()},
    }[name]()
    part = part.reshape(*free, -1)
    return torch.cat([position, part], dim=-1) if has_position(layout) else part


def read(layout: str, values: Tensor) -> tuple[Tensor | None, Tensor]:
    """The positions, if any, and rotations of poses, by SciPy and by plain indexing."""
    from scipy.spatial.transform import Rotation

    values = values.double()
    if layout == "matrix":
        return values[..., :3, 3], values[..., :3, :3]
    if layout == "rotation":
        return None, values
    name = layout.removeprefix("xyz_")
    position, part = (values[..., :3], values[..., 3:]) if has_position(layout) else (None, values)
    flat = part.reshape(-1, part.shape[-1])
    if "rot6d" in name:
        first, second = flat[:, :3], flat[:, 3:]
        lines = torch.stack([first, second, torch.linalg.cross(first, second)], dim=-2)
        rotation = lines if name.endswith("rows") else lines.mT
    elif "quat" in name:
        rotation = torch.from_numpy(
            Rotation.from_quat(flat if name.endswith("xyzw") else flat.roll(-1, -1)).as_matrix()
        )
    elif name in EULER:
        rotation = torch.from_numpy(Rotation.from_euler(EULER[name], flat.numpy()).as_matrix())
    else:
        rotation = torch.from_numpy(Rotation.from_rotvec(flat).as_matrix())
    return position, rotation.reshape(*part.shape[:-1], 3, 3)


def markers(num_clouds: int, *, seed: int = 0) -> dict[str, tuple[Any, str]]:
    """One signal of every kind and layout, (B, HORIZON, ...): name -> values and kind."""
    generator = seeded(seed)
    place = torch.rand(num_clouds, HORIZON, 3, generator=generator, dtype=torch.float64) - 0.5
    joints = torch.randn(num_clouds, 7, generator=generator)
    rotation = rotations_of(num_clouds, seed=seed)
    shift = 0.1 * place.flip(1)
    told: dict[str, tuple[Any, str]] = {
        "joints": (joints, "invariant"),
        "gripper": (torch.arange(num_clouds) % 2 == 0, "invariant"),
        "place": (place.float(), "position"),
        "shift": (shift.float(), "displacement"),
        "force": ((3.0 * shift).half(), "direction"),
        "language": (tuple(f"pick cube {b}" for b in range(num_clouds)), "text"),
        "delta action": (
            torch.cat([shift.float(), joints[:, None, :4].repeat(1, HORIZON, 1)], -1),
            "displacement + invariant 4",
        ),
    }
    for layout in LAYOUTS:
        told[f"pose/{layout}"] = (written(layout, place, rotation).float(), f"pose {layout}")
        told[f"delta/{layout}"] = (written(layout, shift, rotation).float(), f"delta_pose {layout}")
    whole = torch.cat(
        [written("xyz_quat_xyzw", place, rotation).float(), joints[:, None, :1].repeat(1, HORIZON, 1)], -1
    )
    told["action"] = (whole, "pose xyz_quat_xyzw + invariant 1")
    return told


def with_signals(cloud: PointCloud, frame: str | None, *, poses: bool = True, seed: int = 0) -> PointCloud:
    """Attach signals of every kind, in a frame that the cloud knows, or in the coordinates that it has now (None)."""
    for name, (values, kind) in markers(cloud.num_clouds, seed=seed).items():
        if poses or not kind.startswith("pose"):
            is_spatial = kind.split()[0] not in ("invariant", "text")
            cloud = cloud.with_signal(name, values, kind, frame if is_spatial else None)
    return cloud
