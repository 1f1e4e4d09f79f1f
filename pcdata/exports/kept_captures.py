"""The captures behind a dataset of clouds: those that a build kept, or those that are processed on the fly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from pcdata.datasets import CachedCloudDataset, CloudDataset
from pcdata.datasets.samples import SampleDataset
from pcdata.errors import CacheError, ConfigError
from pcdata.files.sample_names import check_known
from pcdata.io import open_source
from pcdata.io.sources.capture_source import CaptureSource
from pcdata.io.store.sample_keys import key_of
from pcdata.structures import DepthFrame, Episode, Signal

_FOLDER = "raw"  # beside the clouds of a shard, where the configuration says keep_raw


class _KeptCaptures:
    """The captures that a build kept beside its clouds, in the order of its samples."""

    kind = "kept captures"

    def __init__(self, dataset: CachedCloudDataset) -> None:
        self._dataset = dataset
        self.name = dataset.folder.name
        self.ids = list(dataset.ids)
        self.fingerprint = dataset.manifest.fingerprint
        self._known = {sample_id: number for number, sample_id in enumerate(self.ids)}

    @property
    def episodes(self) -> list[Episode]:
        """The episodes over the ids, as the build kept them."""
        return self._dataset.episodes

    def __len__(self) -> int:
        return len(self.ids)

    def load(self, sample_id: str) -> DepthFrame:
        """Read one capture.

        Raises:
            CaptureError: no sample has this id, or what was kept cannot be read.
            CacheError: nothing was kept of it.
        """
        check_known(repr(self), sample_id, self._known)
        folder = self._dataset.shard_of(self._known[sample_id]) / _FOLDER / key_of(sample_id)
        views = sorted(folder.glob("view*"))
        if not views:
            raise CacheError(f"{folder}: the capture of sample {sample_id!r} is not there; rebuild the dataset")
        source = open_source(folder if len(views) > 1 else views[0])
        frame = source.load(source.ids[0])
        assert isinstance(frame, DepthFrame)
        return replace(frame, sample_id=sample_id, capture_index=self._known[sample_id])

    def signals(self, sample_id: str) -> Mapping[str, Signal]:
        """Return the signals of one capture.

        Raises:
            CaptureError, CacheError: as :meth:`load`.
        """
        return self.load(sample_id).recorded_signals

    def __repr__(self) -> str:
        return f"the captures kept in {self._dataset!r}"


def captures_of(target: str, dataset: SampleDataset) -> CaptureSource:
    """Return the captures that a dataset makes its clouds of, for a target that is made of images.

    Raises:
        ConfigError: a built dataset kept none, or the dataset gives every sample several times.
    """
    if isinstance(dataset, CachedCloudDataset):
        if not dataset.manifest.keep_raw:
            raise ConfigError(
                f"export: {target} is made of depth images, but {dataset!r} has clouds alone; give the captures that "
                "it was built from, or build it with output: {keep_raw: true}, which keeps them"
            )
        return _KeptCaptures(dataset)
    if dataset.repeats > 1:
        raise ConfigError(
            f"export: {target} is made of depth images, on which nothing is drawn, so {dataset.repeats} copies of each "
            "would be alike; give the dataset without repeats"
        )
    if not isinstance(dataset, CloudDataset):
        raise ConfigError(f"export: {target} is made of depth images, and {dataset!r} does not say where they are")
    return dataset.source


def steps_not_run(dataset: SampleDataset) -> str | None:
    """Say which steps of a dataset are not in its captures; None = it has none."""
    pipeline: Any = dataset.pipeline if isinstance(dataset, CachedCloudDataset) else dataset.transform
    steps = list(getattr(pipeline, "steps", [] if pipeline is None else [pipeline]))
    if not steps:
        return None
    names = ", ".join(type(step).__name__ for step in steps)
    return f"the images are as they were recorded: {names} did not run on them, since the loader has steps of its own"
