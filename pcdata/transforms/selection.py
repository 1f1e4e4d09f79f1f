"""Removing points by what they are: repeats, points that are no numbers, labels, views, ranges of a field."""

from __future__ import annotations

from collections.abc import Collection

import torch
from torch import Tensor

from pcdata.errors import ConfigError, DTypeError
from pcdata.functional.rows import ptr_after_mask
from pcdata.functional.selection import duplicate_mask
from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.transforms.families import GEOMETRY, RemoveTransform
from pcdata.transforms.field_types import Name


class RemoveDuplicates(RemoveTransform):
    """Drop points that repeat an earlier one of their cloud, coordinate for coordinate; the first one stays."""

    def looks_at(self) -> Collection[str]:
        """The points."""
        return GEOMETRY

    def pick(self, cloud: PointCloud, streams: Streams) -> tuple[Tensor, Tensor]:
        """Pick the first of equal points."""
        keep = ~duplicate_mask(cloud.points, cloud.ptr)
        return keep, ptr_after_mask(keep, cloud.ptr)


class DropNonFinite(RemoveTransform):
    """Drop points with NaN or infinity among their coordinates, or in other fields; the history counts them.

    Args:
        fields: where to look.
    """

    decides_by = "point"

    fields: tuple[Name, ...] = ("points",)

    def check_fields(self) -> None:
        """Require a field."""
        if not self.fields:
            raise ConfigError("DropNonFinite: fields must name one, such as points")

    def looks_at(self) -> Collection[str]:
        """The fields."""
        return (*GEOMETRY, *self.fields)

    def pick(self, cloud: PointCloud, streams: Streams) -> tuple[Tensor, Tensor]:
        """Pick the rows that are numbers in every field."""
        keep = torch.ones(cloud.num_points, dtype=torch.bool, device=cloud.device)
        for name in self.fields:
            finite = torch.isfinite(_field("DropNonFinite", cloud, name))
            keep &= finite if finite.ndim == 1 else finite.flatten(1).all(1)
        return keep, ptr_after_mask(keep, cloud.ptr)


class KeepValues(RemoveTransform):
    """Keep the points whose value of a field is one of some, or lies in a range.

    By label: ``KeepValues(values=(1, 2))``; all that has one: ``KeepValues(values=(-1,), invert=True)``. By the view
    that MergeViews wrote: ``KeepValues(field="view", values=(0,))``. By intensity, curvature and the like:
    ``KeepValues(field="intensity", low=0.1)``. By confidence: see KeepConfidence.

    Args:
        field: one number per point.
        values: integers that stay.
        low: smallest value that stays.
        high: largest value that stays.
        invert: drop those, and keep the others.
    """

    decides_by = "point"

    field: Name = "labels"
    values: tuple[int, ...] | None = None
    low: float | None = None
    high: float | None = None
    invert: bool = False

    def check_fields(self) -> None:
        """Require values or a range."""
        has_range = self.low is not None or self.high is not None
        if (self.values is None) != has_range:
            raise ConfigError("KeepValues: give either values, or low, high or both")
        if self.low is not None and self.high is not None and self.low > self.high:
            raise ConfigError(f"KeepValues: low {self.low} exceeds high {self.high}")

    def looks_at(self) -> Collection[str]:
        """The field."""
        return (*GEOMETRY, self.field)

    def pick(self, cloud: PointCloud, streams: Streams) -> tuple[Tensor, Tensor]:
        """Pick by the field's values."""
        value = _field("KeepValues", cloud, self.field)
        if value.ndim != 1:
            raise DTypeError(
                f"KeepValues: field {self.field!r} has {tuple(value.shape[1:])} numbers per point, not one"
            )
        if self.values is not None:
            if value.is_floating_point():
                raise DTypeError(f"KeepValues: field {self.field!r} is {value.dtype}; give low and high, not values")
            keep = torch.isin(value.long(), torch.tensor(self.values, dtype=torch.int64, device=value.device))
        else:
            keep = torch.ones_like(value, dtype=torch.bool)
            keep &= value >= self.low if self.low is not None else keep
            keep &= value <= self.high if self.high is not None else keep
        keep = keep != self.invert
        return keep, ptr_after_mask(keep, cloud.ptr)


def _field(where: str, cloud: PointCloud, name: str) -> Tensor:
    fields = cloud.fields()
    if name not in fields:
        advice = "; MergeViews writes it" if name == "view" else ""
        raise DTypeError(f"{where}: the cloud has no field {name!r}; it has {', '.join(sorted(fields))}{advice}")
    return fields[name]
