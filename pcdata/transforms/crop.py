"""CropWorkspace: keep the points inside a box given in a named frame."""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.errors import ConfigError, NonFiniteError, PcdataError
from pcdata.functional.rows import inside_box, ptr_after_mask, transform_points
from pcdata.geometry import rigid
from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.transforms.families import SelectTransform
from pcdata.transforms.field_types import Matrix4, Name, Vec3


class CropWorkspace(SelectTransform):
    """Keep the points inside a box, its faces included.

    The box is axis-aligned in ``frame``; with ``frame_from_box`` it is axis-aligned in its own coordinates and stands
    in the frame at that pose (an oriented box).

    Args:
        frame: the frame that the box is given in.
        lower: metres, smallest x, y, z.
        upper: metres, largest x, y, z.
        frame_from_box: rigid pose of an oriented box; None = aligned with the frame.
    """

    needs_metres = True

    frame: Name
    lower: Vec3
    upper: Vec3
    frame_from_box: Matrix4 | None = None

    def check_fields(self) -> None:
        """Require lower < upper and a rigid pose."""
        if not all(low < high for low, high in zip(self.lower, self.upper)):
            raise ConfigError(f"CropWorkspace: lower must be below upper on every axis, got {self.lower}, {self.upper}")
        if self.frame_from_box is not None:
            try:
                rigid.check_rigid(
                    "CropWorkspace.frame_from_box", torch.tensor(self.frame_from_box, dtype=torch.float64, device="cpu")
                )
            except PcdataError as error:
                raise ConfigError(str(error)) from error

    def frame_needed(self) -> str:
        """The frame of the box."""
        return self.frame

    def pick(self, cloud: PointCloud, streams: Streams) -> tuple[Tensor, Tensor]:
        """Pick the rows inside."""
        points = cloud.points
        if self.frame_from_box is not None:
            pose = torch.tensor(self.frame_from_box, dtype=torch.float64, device=cloud.device)
            box_from_frame = rigid.invert_rigid(pose).repeat(cloud.num_clouds, 1, 1)
            points = transform_points(points, cloud.ptr, box_from_frame)
        inside = inside_box(points, self.lower, self.upper)
        if inside is None:
            raise NonFiniteError("CropWorkspace: the cloud has NaN or infinite coordinates; drop those points first")
        return inside, ptr_after_mask(inside, cloud.ptr)
