"""From a list of clouds to a batch, for ``DataLoader(collate_fn=...)``."""

from __future__ import annotations

from collections.abc import Sequence

from pcdata.errors import DTypeError, ShapeError
from pcdata.structures import PaddedClouds, PointCloud


def collate_packed(clouds: Sequence[PointCloud]) -> PointCloud:
    """Pack clouds of any lengths into one batch, cut by ``ptr``; nothing is padded or lost."""
    return _batch("collate_packed", clouds)


def collate_padded(clouds: Sequence[PointCloud]) -> PaddedClouds:
    """Pad clouds to the longest of the batch; ``mask`` says which rows are real."""
    return _batch("collate_padded", clouds).padded()


def collate_fixed(clouds: Sequence[PointCloud]) -> PaddedClouds:
    """Stack clouds that all have the same number of points.

    Raises:
        ShapeError: the counts differ.
    """
    batch = _batch("collate_fixed", clouds)
    counts = batch.counts.tolist()
    if min(counts) != max(counts):
        raise ShapeError(
            f"collate_fixed: clouds must have one count, got {min(counts)} to {max(counts)} points; end the pipeline "
            "with FarthestPointSample or RandomSample, or use collate_padded or collate_packed"
        )
    return batch.padded()


def _batch(where: str, clouds: Sequence[PointCloud]) -> PointCloud:
    for cloud in clouds:
        if not isinstance(cloud, PointCloud):
            raise DTypeError(
                f"{where}: takes a list of PointCloud, got a {type(cloud).__name__} in it; give the dataset a "
                "transform that ends in points, and call the function on samples, not on a batch"
            )
    return PointCloud.cat(clouds)
