"""Fewer points: VoxelDownsample, samples of points far apart or at random."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Sequence
from typing import Annotated, Any

import torch
from annotated_types import Ge
from torch import Tensor

from pcdata.contracts.asked_later import is_set
from pcdata.contracts.dispatch import roomy_body
from pcdata.contracts.on_host import counts_of
from pcdata.errors import ConfigError, DTypeError, TooFewPointsError
from pcdata.functional.fixed_rows import FixedRows
from pcdata.functional.noise import random_order, random_with_repeats
from pcdata.functional.rows import cloud_of_rows, group_first, ptr_after_mask, ptr_from_counts
from pcdata.functional.sampling import farthest_point_sample, farthest_rows_within, random_sample_index
from pcdata.functional.voxels import find_voxel_size, voxel_downsample, voxel_nearest
from pcdata.rng import Streams
from pcdata.sensors import SensorProfile
from pcdata.structures import METRE, PointCloud
from pcdata.structures.kinds import fillers
from pcdata.transforms.base import Params, Transform, sample_name
from pcdata.transforms.families import GEOMETRY, SelectTransform
from pcdata.transforms.field_types import (
    Count,
    Fraction,
    FromSensor,
    IfShort,
    Metres,
    NonNegative,
    Reduction,
    Unit,
    Vec3,
)
from pcdata.transforms.row_sums import row_sums, sums_when_read

_FEW_ROWS = 1 << 14  # which a history may hold until somebody reads it


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


class _Sample(SelectTransform, abstract=True):
    """A sampler with a fixed count and a stated answer to "too few points".

    Args:
        num_points: points per cloud in the result.
        if_short: repeat / tile: duplicate points; zeros: zero rows; keep: give fewer.
    """

    num_points: Count
    if_short: IfShort = "error"

    def wanted_counts(self, cloud: PointCloud, streams: Streams) -> list[int]:
        """The wanted count of every cloud."""
        return [self.num_points] * cloud.num_clouds

    def sample(self, cloud: PointCloud, counts: list[int], seeds: list[int]) -> Tensor:
        """Of every cloud, one after another, ``counts[b]`` rows in sampling order; it has at least so many."""
        raise NotImplementedError

    def pick(self, cloud: PointCloud, streams: Streams) -> tuple[Tensor, Tensor]:
        """Sample, then fill up short clouds as ``if_short`` says; -1 marks a zero row."""
        wanted = self.wanted_counts(cloud, streams)
        counts = self._counts(cloud, wanted, counts_of(cloud.ptr))
        seeds = streams.seeds().tolist() if self.is_random else [0] * cloud.num_clouds
        given = counts if self.if_short == "keep" else wanted
        rows = self.sample(cloud, counts, seeds)
        if given != counts:
            rows = self._fill_up(rows, counts, given, seeds)
        return rows, ptr_from_counts(given, device=cloud.device)

    def _counts(self, cloud: PointCloud, wanted: list[int], available: list[int]) -> list[int]:
        """Return how many of the wanted rows each cloud has; refuse a short one if that is asked."""
        for b, (want, have) in enumerate(zip(wanted, available, strict=True)):
            if have < want and (self.if_short == "error" or (have == 0 and self.if_short != "keep")):
                raise TooFewPointsError(
                    f"{type(self).__name__}: cloud {b}{sample_name(cloud, b)} has {have} points, fewer than the "
                    f"{want} asked; ask for fewer (num_points)" + ("" if have == 0 else ", or choose if_short")
                )
        return [min(pair) for pair in zip(wanted, available)]

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Select the rows and blank those marked -1."""
        if self.if_short != "zeros":  # no other way marks rows
            return data.select(params["index"], params["ptr"])
        blank = params["index"] < 0
        chosen = data.select(params["index"].clamp(min=0), params["ptr"])
        fields = chosen.fields()
        filler = fillers(fields, chosen.kinds)
        return chosen.with_fields(**{name: _blanked(value, blank, filler[name]) for name, value in fields.items()})

    def told_rows(self, data: PointCloud, params: Params) -> Sequence[int] | None:
        """Leave it to who reads the history to look at a few rows."""
        if self.decides_by != "rows":
            return super().told_rows(data, params)
        # Among rows that lie between others, their place without these tells which they are.
        index, ptr = params.get("place", params["index"]), params.get("place_ptr", data.ptr)
        if index.shape[0] > _FEW_ROWS or not index.is_cpu:
            return row_sums({"index": index, "ptr": params["ptr"]}, ptr)
        return sums_when_read(index, params["ptr"], ptr)

    def _fill_up(self, rows: Tensor, counts: list[int], wanted: list[int], seeds: list[int]) -> Tensor:
        """Lengthen the ``counts`` rows of every cloud to as many as are wanted."""
        have, ptr = torch.tensor(counts, dtype=torch.int64, device="cpu"), ptr_from_counts(wanted)
        cloud = cloud_of_rows(ptr)
        place = torch.arange(len(cloud), dtype=torch.int64, device="cpu") - ptr[cloud]
        missing = place >= have[cloud]
        if self.if_short == "repeat" and self.is_random:
            # Other streams than those that drew the samples themselves.
            more = torch.tensor(wanted, dtype=torch.int64, device="cpu") - have
            others = torch.tensor(seeds, dtype=torch.int64, device="cpu") ^ 1
            source = ptr_from_counts(counts)[cloud] + place
            source[missing] = random_with_repeats(have, more, others)
            return rows[source.to(rows.device)]
        if self.if_short != "zeros":
            place %= have[cloud]
        source = ptr_from_counts(counts)[cloud] + place
        if self.if_short == "zeros":
            source[missing] = len(rows)
        return torch.cat([rows, rows.new_tensor([-1])])[source.to(rows.device)]


class _FarthestPoints(_Sample, abstract=True):
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
        counts = self._counts(data, wanted, counts_of(ptr))
        index, place = farthest_rows_within(data.points.detach(), ptr, within, counts)
        given = counts if self.if_short == "keep" else wanted
        if given != counts:
            index, place = (self._fill_up(rows, counts, given, no_seeds) for rows in (index, place))
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


class RandomSample(_Sample):
    """Sample ``num_points`` points at random without replacement.

    Cheap, and what several official loaders do; it keeps the density of the sensor, so close surfaces get most points
    and thin or far objects may get none. FarthestPointSample covers evenly. A short cloud is filled up with random
    duplicates (``if_short: repeat``) or with the same permutation again (``tile``). With replacement every row is drawn
    anew, so no cloud but an empty one is short; some loaders do so even where there are enough points.

    Args:
        with_replacement: draw every row anew: about a third of the points of a full cloud come twice.
    """

    is_random = True
    decides_by = "count"
    version = 2

    with_replacement: bool = False

    def pick(self, cloud: PointCloud, streams: Streams) -> tuple[Tensor, Tensor]:
        """Draw short clouds too with replacement, unless they are to get zero rows or to stay short."""
        if not self.with_replacement or self.if_short in ("zeros", "keep") or 0 in counts_of(cloud.ptr):
            return super().pick(cloud, streams)
        wanted = self.wanted_counts(cloud, streams)
        rows = self.sample(cloud, wanted, streams.seeds().tolist())
        return rows, ptr_from_counts(wanted, device=cloud.device)

    def sample(self, cloud: PointCloud, counts: list[int], seeds: list[int]) -> Tensor:
        """Take the head of a random permutation of each cloud, or draw each row anew."""
        have, wanted, own = (
            torch.tensor(values, dtype=torch.int64, device="cpu") for values in (counts_of(cloud.ptr), counts, seeds)
        )
        if self.with_replacement and (counts != counts_of(cloud.ptr)):
            rows = random_with_repeats(have, wanted, own)
            whole = have == wanted  # all that a short cloud has, once
            rows[whole[cloud_of_rows(ptr_from_counts(wanted))]] = random_order(have, torch.where(whole, have, 0), own)
        else:
            rows = random_order(have, wanted, own)
        return rows.to(cloud.device)


class RandomShuffle(SelectTransform):
    """Put the points of every cloud in random order: for models that look at the first points alone."""

    is_random = True
    decides_by = "count"
    version = 2

    def pick(self, cloud: PointCloud, streams: Streams) -> tuple[Tensor, Tensor]:
        """Draw a permutation of each cloud."""
        return random_sample_index(cloud.ptr, counts_of(cloud.ptr), streams.seeds())


class RandomPointCount(RandomSample):
    """Sample a random number of points, within ``spread`` of ``num_points``: a model must not count on the count."""

    spread: Fraction = 0.2

    def wanted_counts(self, cloud: PointCloud, streams: Streams) -> list[int]:
        """Draw the count of every cloud."""
        factor = streams.uniform(1.0 - self.spread, 1.0 + self.spread)
        counts: list[int] = (factor * self.num_points).round().clamp(min=1).long().tolist()
        return counts


def _blanked(values: Tensor, blank: Tensor, filler: int) -> Tensor:
    return torch.where(blank.reshape(-1, *[1] * (values.ndim - 1)), torch.full_like(values, filler), values)
