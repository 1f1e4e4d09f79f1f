"""From a list of clouds to a batch, for ``DataLoader(collate_fn=...)``."""

from __future__ import annotations

from collections.abc import Sequence

from pcdata.errors import DTypeError, ShapeError
from pcdata.structures import PaddedClouds, PointCloud


def collate_packed(clouds: Sequence[PointCloud]) -> PointCloud:
    """Pack clouds of any lengths into one batch, cut by ``ptr``; nothing is padded or lost."""
    _check("collate_packed", clouds)
    return PointCloud.cat(clouds)


def collate_padded(clouds: Sequence[PointCloud]) -> PaddedClouds:
    """Pad clouds to the longest of the batch; ``mask`` says which rows are real."""
    _check("collate_padded", clouds)
    return PointCloud.cat_padded(clouds)


def collate_fixed(clouds: Sequence[PointCloud]) -> PaddedClouds:
    """Stack clouds that all have the same number of points.

    Raises:
        ShapeError: the counts differ.
    """
    _check("collate_fixed", clouds)
    batch = PointCloud.cat_padded(clouds)
    if not bool(batch.mask.all()):
        counts = batch.mask.sum(dim=1).tolist()
        raise ShapeError(
            f"collate_fixed: clouds must have one count, got {min(counts)} to {max(counts)} points; end the pipeline "
            "with FarthestPointSample or RandomSample, or use collate_padded or collate_packed"
        )
    return batch


def _check(where: str, clouds: Sequence[PointCloud]) -> None:
    for cloud in clouds:
        if not isinstance(cloud, PointCloud):
            raise DTypeError(
                f"{where}: takes a list of PointCloud, got a {type(cloud).__name__} in it; give the dataset a "
                "transform that ends in points, and call the function on samples, not on a batch"
            )
