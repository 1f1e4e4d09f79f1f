"""What is exported: a path or an object, opened as the samples that a target takes."""

from __future__ import annotations

import os
from typing import Any

from pcdata.datasets import CachedCloudDataset
from pcdata.errors import ConfigError
from pcdata.exports.target import Target
from pcdata.files.sample_names import check_known
from pcdata.io import open_source
from pcdata.io.sources.capture_source import CaptureSource, checked_ids
from pcdata.io.sources.listing import absolute
from pcdata.io.store.manifest import FILE_NAME
from pcdata.structures import PointCloud


class BuiltClouds:
    """The stored clouds of a built dataset by id; nothing random runs on them."""

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self._dataset = CachedCloudDataset(absolute(folder), augment=None)
        self._position = {sample_id: position for position, sample_id in enumerate(self._dataset.ids)}
        self.fingerprint = self._dataset.manifest.fingerprint

    @property
    def name(self) -> str:
        """The name of the dataset's folder."""
        return self._dataset.folder.name

    @property
    def ids(self) -> list[str]:
        """The sample ids."""
        return list(self._position)

    def __len__(self) -> int:
        return len(self._position)

    def load(self, sample_id: str) -> PointCloud:
        """Read one cloud.

        Raises:
            CaptureError: no sample has this id. CacheError: it is damaged.
        """
        check_known(repr(self), sample_id, self._position)
        return self._dataset[self._position[sample_id]]

    def __repr__(self) -> str:
        return repr(self._dataset)


def is_built(path: str | os.PathLike[str]) -> bool:
    """Say whether a path is a dataset that ``pcdata build`` wrote."""
    return (absolute(path) / FILE_NAME).is_file()


def open_for(target: Target, source: Any) -> CaptureSource:
    """Return the samples for a target; paths are opened.

    Raises:
        ConfigError: captures were given where clouds are exported, or the other way round.
        CaptureError: there are no samples, or two have one id.
        DTypeError: neither a path nor something with ids and load.
    """
    if isinstance(source, str | os.PathLike):
        built = is_built(source)
        if built and target.takes == "captures":
            raise ConfigError(
                f"export: {target.name} is made of depth images, but {source} is a built dataset of clouds; give the "
                "captures that it was built from"
            )
        source = BuiltClouds(source) if built else open_source(source)
    elif isinstance(source, CachedCloudDataset):
        source = BuiltClouds(source.folder)
    checked_ids("export", source)
    opened: CaptureSource = source
    return opened


def identity_of(source: CaptureSource) -> str:
    """Return what a continued export must find unchanged: the fingerprint of a dataset, else the kind of source."""
    fingerprint = getattr(source, "fingerprint", None)
    return fingerprint if isinstance(fingerprint, str) else str(getattr(source, "kind", type(source).__name__))
