"""Fewer points, spread evenly: the average of every voxel."""

from __future__ import annotations

import dataclasses
from typing import Annotated

import torch
from torch import Tensor

from pcdata.errors import ConfigError
from pcdata.functional.rows import group_first, ptr_after_mask
from pcdata.functional.voxels import find_voxel_size, voxel_downsample, voxel_nearest
from pcdata.rng import Streams
from pcdata.sensors import SensorProfile
from pcdata.structures import METRE, PointCloud
from pcdata.transforms.base import Params, Transform
from pcdata.transforms.field_types import Count, FromSensor, Metres, Reduction, Unit, Vec3


class VoxelDownsample(Transform):
    """Average the points of every occupied voxel (Open3D's grid), every field by its kind.

    Positions, colors and other floats are averaged, directions averaged and renormalized, labels and other integers
    decided by vote (the lowest wins a tie); confidence is their lowest, as an average is no better than its parts;
    ``source_index`` is that of the first point in the voxel. Give the voxel size, or the count to reach: then every
    cloud gets the largest size that leaves at least so many points.

    Args:
        voxel_size: edge length of the voxels, in `unit`; one, or one per axis.
        num_points: wanted count instead of a size.
        unit: of voxel_size; a cloud in another one is refused.
        origin: a corner of a voxel; None = half a voxel below each cloud's lowest corner.
        min_points: voxels with fewer points are dropped: stray points are alone in theirs.
        reduce: by field, what its values become instead: their mean, vote, min or max, the first of them, or that of
            the point nearest to the center of the voxel; also for ``points``, by first or nearest.
    """

    # Edge length, in `unit`.
    voxel_size: Annotated[Metres | tuple[Metres, Metres, Metres] | None, FromSensor(SensorProfile.voxel_size)] = None
    num_points: Count | None = None
    unit: Unit = "m"
    origin: Vec3 | None = None
    min_points: Count = 1
    reduce: dict[str, Reduction] = dataclasses.field(default_factory=dict)

    def check_fields(self) -> None:
        """Require exactly one of the two."""
        if (self.voxel_size is None) == (self.num_points is None):
            raise ConfigError("VoxelDownsample: give either voxel_size or num_points")
        if self.voxel_size is None and self.unit != METRE:
            raise ConfigError("VoxelDownsample: unit is that of voxel_size; leave it out, num_points works in any")
        if self.num_points is not None and (self.origin is not None or self.min_points > 1):
            raise ConfigError(
                "VoxelDownsample: num_points finds the size for all voxels of Open3D's grid: no origin, no min_points"
            )
        if self.reduce.get("points", "mean") not in ("mean", "first", "nearest"):
            raise ConfigError(
                f"VoxelDownsample: points are reduced by mean, first or nearest, not {self.reduce['points']}"
            )

    def unit_needed(self) -> str | None:
        """The unit of the voxel size."""
        return None if self.voxel_size is None else self.unit

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Decide the voxel size of every cloud."""
        if self.num_points is not None:
            return {"voxel_size": find_voxel_size(data.points, data.ptr, num_points=self.num_points)}
        size = torch.tensor(self.voxel_size, dtype=torch.float64, device=data.device)
        return {"voxel_size": size.expand(data.num_clouds, *size.shape).clone()}

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Reduce every field voxel by voxel."""
        sizes = params["voxel_size"]
        means, ptr, inverse = voxel_downsample(
            data.points, data.ptr, voxel_size=sizes, origin=self.origin, min_points=self.min_points
        )
        if self.min_points > 1:
            full = inverse >= 0
            data, inverse = data.select(full, ptr_after_mask(full, data.ptr)), inverse[full]
        reduce: dict[str, str | Tensor] = {**self.reduce}
        if "nearest" in reduce.values():
            origin = None if self.origin is None else data.points.new_tensor(self.origin, dtype=torch.float64)
            origin = None if origin is None else origin.expand(data.num_clouds, 3)
            rows = voxel_nearest(data.points, data.ptr, inverse, len(means), voxel_size=sizes, origin=origin)
            reduce = {name: rows if how == "nearest" else how for name, how in reduce.items()}
        chosen = reduce.pop("points", "mean")
        if chosen != "mean":
            means = data.points[chosen if isinstance(chosen, Tensor) else group_first(inverse, len(means))]
        return data.averaged(inverse, ptr, points=means, reduce=reduce)
