"""Samples of points far apart: FarthestPointSample from a row that is stated, RandomFarthestPointSample from any."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Annotated, Any

import torch
from annotated_types import Ge
from torch import Tensor

from pcdata.contracts.asked_later import is_set
from pcdata.contracts.dispatch import roomy_body
from pcdata.contracts.on_host import counts_of
from pcdata.errors import DTypeError
from pcdata.functional.fixed_rows import FixedRows
from pcdata.functional.rows import ptr_from_counts
from pcdata.functional.sampling import farthest_point_sample, farthest_rows_within
from pcdata.structures import PointCloud
from pcdata.transforms.base import Params
from pcdata.transforms.families import GEOMETRY
from pcdata.transforms.field_types import NonNegative
from pcdata.transforms.sampler import Sampler


class _FarthestPoints(Sampler, abstract=True):
    """A sampler of points far apart, in space alone or in space and color.

    Args:
        color_weight: how far apart black and pure red count beside a distance of 1 in the cloud's unit; 0 = not at all.
        balance_labels: every label gets as many points as it has, up to an equal share, in turns by label.
    """

    color_weight: NonNegative = 0.0
    balance_labels: bool = False

    def looks_at(self) -> Collection[str] | None:
        """The points, and colors and labels where they count; zero rows are zero in every field."""
        if self.if_short == "zeros":
            return None
        return (*GEOMETRY, *["colors"] * bool(self.color_weight), *["labels"] * self.balance_labels)

    def starts(self, cloud: PointCloud, seeds: list[int]) -> dict[str, Any]:
        """Where each cloud begins, as farthest_point_sample takes it."""
        raise NotImplementedError

    def sample(self, cloud: PointCloud, counts: list[int], seeds: list[int]) -> Tensor:
        """Sample all clouds in one call."""
        name = type(self).__name__
        if self.color_weight and cloud.colors is None:
            raise DTypeError(f"{name}: color_weight is {self.color_weight} but the cloud has no colors; leave it out")
        if self.balance_labels and cloud.labels is None:
            raise DTypeError(f"{name}: balance_labels is on but the cloud has no labels; put ClusterObjects before it")
        features = cloud.points
        if self.color_weight and cloud.colors is not None:
            features = torch.cat([features, self.color_weight * cloud.colors], dim=1)
        given = self.starts(cloud, seeds)
        labels = cloud.labels if self.balance_labels else None
        return farthest_point_sample(features, cloud.ptr, num_samples=counts, labels=labels, **given)[0]


class FarthestPointSample(_FarthestPoints):
    """Sample exactly ``num_points`` points, each the farthest from those before it.

    With ``if_short`` repeat or tile, a short cloud's points come again in sampling order.

    Args:
        start: row of each cloud to start at, 0 = its first; the last one where a cloud has fewer.
    """

    start: Annotated[int, Ge(0)] = 0

    def decides_within(self, share: float) -> bool:
        """Where points alone count, and the first comes first."""
        return not (self.color_weight or self.balance_labels or self.start)

    def params_within(self, data: PointCloud, within: Tensor, ptr: Tensor) -> Params:
        """Sample among some rows."""
        wanted, no_seeds = [self.num_points] * data.num_clouds, [0] * data.num_clouds
        counts = self.checked_counts(data, wanted, counts_of(ptr))
        index, place = farthest_rows_within(data.points.detach(), ptr, within, counts)
        given = counts if self.if_short == "keep" else wanted
        if given != counts:
            index, place = (self.filled_up(rows, counts, given, no_seeds) for rows in (index, place))
        return {"index": index, "ptr": ptr_from_counts(given, device=data.device), "place": place, "place_ptr": ptr}

    def fixed_work(self, like: FixedRows) -> Callable[[FixedRows], FixedRows] | None:
        """Sample by place alone, from the first row; a cloud that has too few is left to others."""
        body = roomy_body("farthest_rows", like.points.device)
        if body is None or self.color_weight or self.balance_labels or self.start or like.normals is not None:
            return None
        counts = [self.num_points] * (len(like.ptr) - 1)
        picked_ptr = ptr_from_counts(counts, device=like.points.device)

        def work(rows: FixedRows) -> FixedRows:
            is_set((rows.ptr.diff() < self.num_points).any().reshape(1))
            picks = body(rows.points, rows.ptr, counts).clamp_(max=len(rows.points) - 1)
            return FixedRows(
                rows.points[picks],
                rows.source_index[picks],
                picked_ptr,
                rows.viewpoint,
                picks,
                counts=tuple(counts),
            )

        return work

    def starts(self, cloud: PointCloud, seeds: list[int]) -> dict[str, Any]:
        """Return the row, as far as the clouds have it."""
        return {"start": (cloud.counts - 1).clamp(min=0, max=self.start)} if self.start else {}


class RandomFarthestPointSample(_FarthestPoints):
    """Sample ``num_points`` points far apart, starting at a random one of each cloud: another covering every time."""

    is_random = True
    version = 2

    def starts(self, cloud: PointCloud, seeds: list[int]) -> dict[str, Any]:
        """Return the seeds that the start is drawn from."""
        return {"seeds": torch.tensor(seeds, dtype=torch.int64, device=cloud.device)}
