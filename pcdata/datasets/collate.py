"""From a list of clouds to a batch, for ``DataLoader(collate_fn=...)``."""

from __future__ import annotations

import bisect
import itertools
from collections.abc import Callable, Sequence
from typing import Any

from pcdata.contracts.numbers import whole_number
from pcdata.contracts.on_host import counts_of
from pcdata.datasets.window_batch import WindowBatch, window_batch
from pcdata.errors import ConfigError, DTypeError, ShapeError
from pcdata.registry import Registry
from pcdata.structures import PaddedClouds, PointCloud
from pcdata.structures.unbatched import Unbatched

Collate = Callable[..., Any]  # of a sequence of clouds

COLLATES: Registry[Collate] = Registry("collate function")

_PREFIX = "collate_"


def register_collate(collate: Collate) -> Collate:
    """Make a function ``collate_NAME`` known to ``loader: {collate: NAME}``; a decorator.

    Raises:
        ConfigError: it is no function of that name, or the name exists.
    """
    name = getattr(collate, "__name__", "")
    if not (callable(collate) and name.startswith(_PREFIX) and name != _PREFIX):
        raise ConfigError(f"register_collate: must be a function called {_PREFIX}NAME, got {collate!r:.100}")
    COLLATES.add(name.removeprefix(_PREFIX), collate)
    return collate


@register_collate
def collate_packed(clouds: Sequence[PointCloud]) -> PointCloud:
    """Pack clouds of any lengths into one batch, cut by ``ptr``; nothing is padded or lost."""
    _check("collate_packed", clouds)
    return PointCloud.cat(clouds)


@register_collate
def collate_padded(clouds: Sequence[PointCloud], *, buckets: Sequence[int] = ()) -> PaddedClouds:
    """Pad clouds to the longest of the batch; ``mask`` says which rows are real.

    Args:
        clouds: the samples.
        buckets: the lengths that batches may have, rising: the longest cloud is rounded up to one of them, so that
            ``torch.compile`` compiles a network once for each and not for every batch. For a loader,
            ``functools.partial(collate_padded, buckets=(1024, 2048, 4096))``; () = any length.

    Raises:
        ShapeError: a cloud is longer than the last bucket.
        ConfigError: the buckets do not rise from 1 or more.
    """
    where = "collate_padded"
    _check(where, clouds)
    if not buckets:
        return PointCloud.cat_padded(clouds)
    lengths = [whole_number(where, "a bucket", bucket) for bucket in buckets]
    if lengths[0] < 1 or any(one >= other for one, other in itertools.pairwise(lengths)):
        raise ConfigError(
            f"{where}: buckets must be lengths that rise, such as (1024, 2048, 4096), got {buckets!r:.100}"
        )
    batches = clouds.batches if isinstance(clouds, Unbatched) else clouds
    longest = max((int(one.counts.max()) for one in batches), default=0)
    place = bisect.bisect_left(lengths, longest)
    if place == len(lengths):
        raise ShapeError(
            f"{where}: a cloud has {longest} points, more than the last bucket {lengths[-1]}; add a bucket that holds "
            "it, or end the pipeline with RandomSample or FarthestPointSample"
        )
    return PointCloud.cat_padded(clouds, lengths[place])


@register_collate
def collate_fixed(clouds: Sequence[PointCloud]) -> PaddedClouds:
    """Stack clouds that all have the same number of points.

    Raises:
        ShapeError: the counts differ.
    """
    _check("collate_fixed", clouds)
    batches = clouds.batches if isinstance(clouds, Unbatched) else clouds
    counts = {*itertools.chain.from_iterable(counts_of(batch.ptr) for batch in batches)}
    if len(counts) > 1:
        raise ShapeError(
            f"collate_fixed: clouds must have one count, got {min(counts)} to {max(counts)} points; end the pipeline "
            "with FarthestPointSample or RandomSample, or use collate_padded or collate_packed"
        )
    return PointCloud.cat_padded(clouds)


@register_collate
def collate_windows(windows: Sequence[PointCloud]) -> WindowBatch:
    """Stack windows of :class:`EpisodeWindows`: (B, T, M, 3) points, (B, T, ...) signals, (B, horizon, ...) actions.

    :func:`collate_packed` packs them instead, B * T clouds in a row.

    Raises:
        ShapeError: the windows differ in their number of clouds, or in their actions.
    """
    _check("collate_windows", windows)
    return window_batch("collate_windows", windows)


def _check(where: str, clouds: Sequence[PointCloud]) -> None:
    if isinstance(clouds, Unbatched):
        return
    for cloud in clouds:
        if not isinstance(cloud, PointCloud):
            raise DTypeError(
                f"{where}: takes a list of PointCloud, got a {type(cloud).__name__} in it; give the dataset a "
                "transform that ends in points, and call the function on samples, not on a batch"
            )
