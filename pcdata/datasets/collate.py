"""From a list of clouds to a batch, for ``DataLoader(collate_fn=...)``."""

from __future__ import annotations

from collections.abc import Sequence

from pcdata.errors import ShapeError
from pcdata.structures import PaddedClouds, PointCloud


def collate_packed(clouds: Sequence[PointCloud]) -> PointCloud:
    """Pack clouds of any lengths into one batch, cut by ``ptr``; nothing is padded or lost."""
    return PointCloud.cat(clouds)


def collate_padded(clouds: Sequence[PointCloud]) -> PaddedClouds:
    """Pad clouds to the longest of the batch; ``mask`` says which rows are real."""
    return PointCloud.cat(clouds).padded()


def collate_fixed(clouds: Sequence[PointCloud]) -> PaddedClouds:
    """Stack clouds that all have the same number of points.

    Raises:
        ShapeError: the counts differ.
    """
    batch = PointCloud.cat(clouds)
    counts = batch.counts.tolist()
    if min(counts) != max(counts):
        raise ShapeError(
            f"collate_fixed: clouds must have one count, got {min(counts)} to {max(counts)} points; end the pipeline "
            "with FarthestPointSample or RandomSample, or use collate_padded or collate_packed"
        )
    return batch.padded()
