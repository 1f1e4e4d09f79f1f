"""Points at random: so many of them, about so many, or all in another order."""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.contracts.on_host import counts_of
from pcdata.functional.noise import random_order, random_with_repeats
from pcdata.functional.rows import cloud_of_rows, ptr_from_counts
from pcdata.functional.sampling import random_sample_index
from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.transforms.families import SelectTransform
from pcdata.transforms.field_types import Fraction
from pcdata.transforms.sampler import Sampler


class RandomSample(Sampler):
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
