"""Keeping the points inside a region given in a named frame: CropWorkspace, CropPolygon."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from pcdata.errors import ConfigError, DTypeError, NonFiniteError, PcdataError, ShapeError
from pcdata.functional.rows import inside_box, ptr_after_mask, transform_points
from pcdata.functional.selection import box_mask, polygon_mask
from pcdata.geometry import rigid
from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.transforms.families import RemoveTransform
from pcdata.transforms.field_types import Matrix4, Name, Vec3


class CropWorkspace(RemoveTransform):
    """Keep the points inside a box, its faces included.

    The box is axis-aligned in ``frame``; with ``frame_from_box`` it is axis-aligned in its own coordinates and stands
    in the frame at that pose (an oriented box). A box of its own for every cloud comes from two signals.

    Args:
        frame: the frame that the box is given in.
        lower: metres, smallest x, y, z; or the name of a signal with three numbers per cloud.
        upper: metres, largest x, y, z; or the name of a signal.
        frame_from_box: rigid pose of an oriented box; None = aligned with the frame.
        invert: keep what is outside.
    """

    needs_metres = True

    frame: Name
    lower: Vec3 | Name
    upper: Vec3 | Name
    frame_from_box: Matrix4 | None = None
    invert: bool = False

    def check_fields(self) -> None:
        """Require lower < upper and a rigid pose."""
        if isinstance(self.lower, str) != isinstance(self.upper, str):
            raise ConfigError("CropWorkspace: lower and upper are both numbers, or both names of signals")
        lower, upper = self.lower, self.upper
        if not isinstance(lower, str) and not isinstance(upper, str) and any(a >= b for a, b in zip(lower, upper)):
            raise ConfigError(f"CropWorkspace: lower must be below upper on every axis, got {lower}, {upper}")
        if self.frame_from_box is not None:
            try:
                rigid.check_rigid(
                    "CropWorkspace.frame_from_box", torch.tensor(self.frame_from_box, dtype=torch.float64, device="cpu")
                )
            except PcdataError as error:
                raise ConfigError(str(error)) from error

    @property
    def is_plain(self) -> bool:
        """Whether it keeps one box that is aligned with the frame."""
        return self.frame_from_box is None and not self.invert and not isinstance(self.lower, str)

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
        if isinstance(self.lower, str) or isinstance(self.upper, str):
            lower, upper = _signal(cloud, str(self.lower)), _signal(cloud, str(self.upper))
            inside: Tensor | None = box_mask(points, cloud.ptr, lower=lower, upper=upper)
        else:
            inside = inside_box(points, self.lower, self.upper)
        if inside is None:
            raise NonFiniteError(
                "CropWorkspace: the cloud has NaN or infinite coordinates; put DropNonFinite before it"
            )
        keep = ~inside if self.invert else inside
        return keep, ptr_after_mask(keep, cloud.ptr)


def _signal(cloud: PointCloud, name: str) -> Tensor:
    """Return a signal of three numbers per cloud, (B, 3)."""
    if name not in cloud.signals:
        raise DTypeError(
            f"CropWorkspace: the cloud has no signal {name!r}; it has {', '.join(cloud.signals) or 'none'}; attach one "
            "by with_signal(name, values, kind)"
        )
    values = cloud.signals[name]
    if not isinstance(values, Tensor) or values.shape != (cloud.num_clouds, 3):
        shape = tuple(values.shape) if isinstance(values, Tensor) else "text"
        raise ShapeError(
            f"CropWorkspace: signal {name!r} must be a corner per cloud ({cloud.num_clouds}, 3), not {shape}"
        )
    return values.to(cloud.device)


_OTHER_AXES = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}


class CropPolygon(RemoveTransform):
    """Keep the points inside a prism: over a polygon, which may be concave, and between two heights.

    Args:
        frame: the frame that the prism is given in.
        polygon: metres, its corners in order, either way round; (x, y) for axis z, (y, z) for x, (z, x) for y.
        axis: the direction of the prism.
        low: metres, least height along the axis; None = no limit.
        high: metres, largest height along the axis; None = no limit.
        invert: keep what is outside.
    """

    needs_metres = True

    frame: Name
    polygon: tuple[tuple[float, float], ...]
    axis: Literal["x", "y", "z"] = "z"
    low: float | None = None
    high: float | None = None
    invert: bool = False

    def check_fields(self) -> None:
        """Require a polygon, and low < high."""
        if len(set(self.polygon)) < 3:
            raise ConfigError(f"CropPolygon: polygon must have three corners or more, got {self.polygon}")
        if self.low is not None and self.high is not None and self.low >= self.high:
            raise ConfigError(f"CropPolygon: low must be below high, got {self.low}, {self.high}")

    def frame_needed(self) -> str:
        """The frame of the prism."""
        return self.frame

    def pick(self, cloud: PointCloud, streams: Streams) -> tuple[Tensor, Tensor]:
        """Pick the rows inside."""
        inside = polygon_mask(cloud.points[:, _OTHER_AXES[self.axis]].contiguous(), polygon=self.polygon)
        height = cloud.points[:, "xyz".index(self.axis)]
        inside &= height >= self.low if self.low is not None else inside
        inside &= height <= self.high if self.high is not None else inside
        keep = inside != self.invert
        return keep, ptr_after_mask(keep, cloud.ptr)
