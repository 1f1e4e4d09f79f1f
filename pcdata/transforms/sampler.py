"""What all samplers do alike: how many points of each cloud are wanted, and what becomes of clouds that have fewer."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pcdata.contracts.on_host import counts_of
from pcdata.errors import TooFewPointsError
from pcdata.functional.noise import random_with_repeats
from pcdata.functional.rows import cloud_of_rows, ptr_from_counts
from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.structures.kinds import fillers
from pcdata.transforms.base import Params, sample_name
from pcdata.transforms.families import SelectTransform
from pcdata.transforms.field_types import Count, IfShort
from pcdata.transforms.row_sums import row_sums, sums_when_read

_FEW_ROWS = 1 << 14  # which a history may hold until somebody reads it


class Sampler(SelectTransform, abstract=True):
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
        counts = self.checked_counts(cloud, wanted, counts_of(cloud.ptr))
        seeds = streams.seeds().tolist() if self.is_random else [0] * cloud.num_clouds
        given = counts if self.if_short == "keep" else wanted
        rows = self.sample(cloud, counts, seeds)
        if given != counts:
            rows = self.filled_up(rows, counts, given, seeds)
        return rows, ptr_from_counts(given, device=cloud.device)

    def checked_counts(self, cloud: PointCloud, wanted: list[int], available: list[int]) -> list[int]:
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

    def filled_up(self, rows: Tensor, counts: list[int], wanted: list[int], seeds: list[int]) -> Tensor:
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


def _blanked(values: Tensor, blank: Tensor, filler: int) -> Tensor:
    return torch.where(blank.reshape(-1, *[1] * (values.ndim - 1)), torch.full_like(values, filler), values)
