"""Keeping the points inside a region given in a named frame: CropWorkspace, CropPolygon."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Literal

import torch
from torch import Tensor

from pcdata.errors import ConfigError, DTypeError, NonFiniteError, PcdataError, ShapeError
from pcdata.functional.fixed_rows import FixedRows
from pcdata.functional.rows import inside_box, ptr_after_mask, transform_points
from pcdata.functional.selection import box_mask, polygon_mask
from pcdata.geometry import rigid
from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.structures.signal_kinds import poses_of_signal
from pcdata.transforms.base import Params
from pcdata.transforms.decisions import Decisions
from pcdata.transforms.families import GEOMETRY, RemoveTransform, kept_params
from pcdata.transforms.field_types import Matrix4, Name, Vec3


class CropWorkspace(RemoveTransform):
    """Keep the points inside a box, its faces included.

    The box is axis-aligned in ``frame``; with ``frame_from_box`` it is axis-aligned in its own coordinates and stands
    in the frame at that pose (an oriented box). A box of its own for every cloud comes from signals: its corners, its
    pose, or both; a pose moves with its cloud.

    Args:
        frame: the frame that the box is given in.
        lower: metres, smallest x, y, z; or the name of a signal with three numbers per cloud.
        upper: metres, largest x, y, z; or the name of a signal.
        frame_from_box: rigid pose of an oriented box, or the name of a signal that is a pose per cloud; None = aligned
            with the frame.
        invert: keep what is outside.
    """

    needs_metres = True
    decides_by = "point"

    frame: Name
    lower: Vec3 | Name
    upper: Vec3 | Name
    frame_from_box: Matrix4 | Name | None = None
    invert: bool = False

    def check_fields(self) -> None:
        """Require lower < upper and a rigid pose."""
        if isinstance(self.lower, str) != isinstance(self.upper, str):
            raise ConfigError("CropWorkspace: lower and upper are both numbers, or both names of signals")
        lower, upper = self.lower, self.upper
        if not isinstance(lower, str) and not isinstance(upper, str) and any(a >= b for a, b in zip(lower, upper)):
            raise ConfigError(f"CropWorkspace: lower must be below upper on every axis, got {lower}, {upper}")
        if self.frame_from_box is not None and not isinstance(self.frame_from_box, str):
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

    def looks_at(self) -> Collection[str]:
        """The points."""
        return GEOMETRY

    def frame_needed(self) -> str:
        """The frame of the box."""
        return self.frame

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Read the boxes of the clouds, where they have their own, and look which rows are inside."""
        boxes = Params()
        if isinstance(self.lower, str) and isinstance(self.upper, str):
            boxes = {"lower": _corner(data, self.lower), "upper": _corner(data, self.upper)}
        if isinstance(self.frame_from_box, str):
            boxes["frame_from_box"] = _pose(data, self.frame_from_box)
        return self._chosen(data, boxes)

    def fixed_keep(self, like: FixedRows) -> Callable[[FixedRows], Tensor] | None:
        """Mark what is inside one box that is aligned with the frame."""
        if isinstance(self.lower, str) or isinstance(self.upper, str) or not self.is_plain:
            return None
        low, high = (
            torch.tensor(corner, device=like.points.device, dtype=torch.float32) for corner in (self.lower, self.upper)
        )
        return lambda rows: ((rows.points >= low) & (rows.points <= high)).all(dim=1)

    def repeat(self, data: PointCloud, decided: Decisions) -> Params:
        """The boxes that the history tells."""
        like = {"lower": (3,), "upper": (3,), "frame_from_box": (4, 4)}
        boxes = {
            name: decided.values(name, like=torch.empty(0, *shape, dtype=torch.float64, device="cpu")).to(data.device)
            for name, shape in like.items()
            if isinstance(getattr(self, name), str)
        }
        return self._chosen(data, boxes)

    def _chosen(self, cloud: PointCloud, boxes: Params) -> Params:
        """Pick the rows inside boxes of their own, or the one that the fields give."""
        points = cloud.points
        if self.frame_from_box is not None:
            poses = boxes.get("frame_from_box")
            if poses is None:
                pose = torch.tensor(self.frame_from_box, dtype=torch.float64, device=cloud.device)
                poses = pose.repeat(cloud.num_clouds, 1, 1)
            points = transform_points(points, cloud.ptr, rigid.invert_rigid(poses))
        if "lower" in boxes:
            inside: Tensor | None = box_mask(points, cloud.ptr, lower=boxes["lower"], upper=boxes["upper"])
        else:
            assert not isinstance(self.lower, str)  # check_fields
            assert not isinstance(self.upper, str)
            inside = inside_box(points, self.lower, self.upper)
        if inside is None:
            raise NonFiniteError(
                "CropWorkspace: the cloud has NaN or infinite coordinates; put DropNonFinite before it"
            )
        return {**kept_params(inside, cloud.ptr, gone=self.invert), **boxes}


def _signal(cloud: PointCloud, name: str) -> Tensor | tuple[str, ...]:
    if name not in cloud.signals:
        raise DTypeError(
            f"CropWorkspace: the cloud has no signal {name!r}; it has {', '.join(cloud.signals) or 'none'}; attach one "
            "by with_signal(name, values, kind)"
        )
    return cloud.signals[name]


def _corner(cloud: PointCloud, name: str) -> Tensor:
    """Return a signal of three numbers per cloud, (B, 3) float64."""
    values = _signal(cloud, name)
    if not isinstance(values, Tensor) or values.shape != (cloud.num_clouds, 3):
        shape = tuple(values.shape) if isinstance(values, Tensor) else "text"
        raise ShapeError(
            f"CropWorkspace: signal {name!r} must be a corner per cloud ({cloud.num_clouds}, 3), not {shape}"
        )
    return values.to(cloud.device, torch.float64)


def _pose(cloud: PointCloud, name: str) -> Tensor:
    """Return a signal that is a pose per cloud as matrices (B, 4, 4) float64, in the coordinates of the clouds now."""
    values = _signal(cloud, name)
    poses = poses_of_signal(cloud.recorded_signals[name].kind, values) if isinstance(values, Tensor) else None
    if poses is None or poses.shape != (cloud.num_clouds, 4, 4):
        raise ShapeError(
            f"CropWorkspace: signal {name!r} must be one pose per cloud, of a kind such as 'pose xyz_quat_xyzw', not "
            f"{cloud.recorded_signals[name].kind!r}; attach it by with_signal(name, values, kind)"
        )
    return poses.to(cloud.device)


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
    decides_by = "point"

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

    def looks_at(self) -> Collection[str]:
        """The points."""
        return GEOMETRY

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
