"""A built dataset as a source: its clouds as they were stored."""

from __future__ import annotations

from pathlib import Path

from pcdata.datasets.cached import CachedCloudDataset
from pcdata.errors import CaptureError
from pcdata.structures import Episode, PointCloud
from pcdata.structures.captures import Captures


class StoredClouds(Captures):
    """The clouds that ``pcdata build`` stored, by their ids, without the random rest of the pipeline.

    Args:
        folder: what ``pcdata build`` wrote.

    Raises:
        CacheError: the dataset is damaged.
    """

    name = "dataset"

    def __init__(self, folder: str | Path) -> None:
        self._dataset = CachedCloudDataset(folder, augment=None)
        self.folder = self._dataset.folder
        self.manifest = self._dataset.manifest
        self.ids = list(self._dataset.ids)
        self._places = {sample_id: place for place, sample_id in enumerate(self.ids)}
        self.episodes: list[Episode] = self._dataset.episodes

    def __len__(self) -> int:
        return len(self.ids)

    def load(self, sample_id: str) -> PointCloud:
        """Return the cloud as it was stored.

        Raises:
            CaptureError: no sample has this id.
        """
        if sample_id not in self._places:
            raise CaptureError(f"{self.folder}: has no sample {sample_id!r}")
        cloud: PointCloud = self._dataset[self._places[sample_id]]
        return cloud

    def __repr__(self) -> str:
        return repr(self._dataset)
