"""Does a dataset show in one split what it shows in another?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pcdata.datasets.cached import CachedCloudDataset
from pcdata.datasets.near_duplicates import (
    FEWEST,
    SIZE,
    Surface,
    candidates,
    descriptor,
    duplicate_distance,
    thinned,
    thinnings,
)
from pcdata.datasets.splits import Splits
from pcdata.errors import ConfigError
from pcdata.progress import Progress
from pcdata.rng import seeded


@dataclass(frozen=True)
class Leak:
    """Two samples of different splits that show the same."""

    first: str  # sample ids
    second: str
    splits: tuple[str, str]
    distance: float  # root mean square, in the unit of the clouds


@dataclass(frozen=True)
class LeakReport:
    """What a leak check found."""

    leaks: list[Leak] = field(default_factory=list)
    episodes: dict[str, tuple[str, ...]] = field(default_factory=dict)  # recorded episode -> the splits that it is in
    num_samples: int = 0
    num_compared: int = 0  # pairs that were near enough to be compared point by point
    too_small: list[str] = field(default_factory=list)  # ids of clouds with too few points to be told apart
    unit: str = "m"

    @property
    def is_clean(self) -> bool:
        """Whether nothing was found."""
        return not self.leaks and not self.episodes


def check_leaks(
    folder: str | Path,
    *,
    path: str | Path | None = None,
    progress: Progress | None = None,
    comparing: Progress | None = None,
) -> LeakReport:
    """Look for near duplicates across the splits of a dataset: copies, also shuffled, thinned out, noisy or moved.

    Every cloud is read once for its descriptor, and again where another split has one that is nearly alike; memory
    grows by 204 bytes a sample. Of clouds that are alike in one split nothing is said.

    Args:
        folder: the dataset.
        path: of the splits; None = in the dataset.
        progress: called after every cloud that was read for its descriptor.
        comparing: called when there are pairs to compare point by point, and after each with the id of its first.

    Raises:
        CacheError: the dataset or its splits are damaged, or do not fit together.
        ConfigError: there is but one split.
    """
    dataset = CachedCloudDataset(folder, augment=None)
    ids = list(dataset.ids)
    splits = Splits.read(dataset.splits if path is None else path, ids)
    if len(splits.names) < 2:
        raise ConfigError(f"split: {folder} has the one split {splits.names[0]!r}, which shares nothing with another")
    part_of = splits.part_of()
    parts = [np.array([row for row, one in enumerate(ids) if part_of[one] == name], np.int64) for name in splits.names]
    counts = dataset.manifest.index.num_points
    draw = seeded(0)
    times = thinned(counts, draw)
    descriptors, halves, unit = np.zeros((len(ids), SIZE), np.float32), [np.zeros((0, SIZE), np.float32)], "m"
    for row, sample_id in enumerate(ids):
        cloud = dataset._load(row)
        unit = str(cloud.unit)
        points = cloud.points.numpy().astype(np.float64)
        descriptors[row] = descriptor(points)
        halves += [one[None] for one in thinnings(points, int(times[row]), draw)]
        if progress is not None:
            progress(row + 1, len(ids), sample_id)
    pairs = [*candidates(descriptors, counts, parts, np.concatenate(halves))]
    if comparing is not None and pairs:
        comparing(0, len(pairs), "")
    leaks = []
    kept: tuple[int, Surface] | None = None  # a cloud is compared with several others in a row
    for number, (row, other) in enumerate(pairs):
        points = _points(dataset, other)
        if kept is None or kept[0] != row:
            kept = row, Surface(_points(dataset, row), unit == "m")
        surface = kept[1]
        if len(points) > len(surface.points):
            points, surface = surface.points, Surface(points, unit == "m")
        distance = duplicate_distance(points, surface)
        if distance is not None:
            leaks.append(Leak(ids[row], ids[other], (part_of[ids[row]], part_of[ids[other]]), distance))
        if comparing is not None:
            comparing(number + 1, len(pairs), ids[row])
    too_small = [ids[row] for row in np.flatnonzero(counts < FEWEST).tolist()]
    return LeakReport(leaks, _torn_episodes(dataset, part_of), len(ids), len(pairs), too_small, unit)


def _points(dataset: CachedCloudDataset, row: int) -> NDArray[np.float64]:
    return dataset._load(row).points.numpy().astype(np.float64)


def _torn_episodes(dataset: CachedCloudDataset, part_of: dict[str, str]) -> dict[str, tuple[str, ...]]:
    """Return the recorded episodes that are in several splits, as splits of one's own may have them."""
    found: dict[str, dict[str, None]] = {}
    ids: Sequence[str] = dataset.ids
    for episode in dataset.episodes:
        found.setdefault(episode.whole, {}).update(dict.fromkeys(part_of[ids[place]] for place in episode.steps))
    return {name: tuple(splits) for name, splits in found.items() if len(splits) > 1}
