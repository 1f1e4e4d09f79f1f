"""CachedCloudDataset: clouds that a build stored, with the random rest of the pipeline on the fly."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.datasets.batch_transport import batch_memory
from pcdata.datasets.first_touch import FirstTouch
from pcdata.datasets.samples import SampleDataset, runs_on_batches
from pcdata.datasets.splits import FILE_NAME as SPLITS
from pcdata.datasets.splits import Splits
from pcdata.errors import CacheError, ConfigError, DTypeError, PcdataWarning, ShapeError, locate
from pcdata.imports import imported_files
from pcdata.io.store.cloud_forms import CloudForms
from pcdata.io.store.cloud_record import cloud_from_record, signals_from_record
from pcdata.io.store.manifest import FILE_NAME, Manifest
from pcdata.io.store.shards import SIGNALS_KEY, Shards, shard_folder
from pcdata.io.store.url_dataset import UrlShards, fetch, opened_folder
from pcdata.rng import Streams
from pcdata.structures import Episode, PointCloud, Signal
from pcdata.structures.episodes import kept_episodes
from pcdata.structures.unbatched import Unbatched
from pcdata.transforms import Compose, Transform

_MOST_POINTS = (
    1 << 18
)  # that go through the steps at once: some megabytes, and memory that many large clouds do not raise


class CachedCloudDataset(SampleDataset):
    """Read a dataset that ``pcdata build`` wrote.

    The stored clouds are the longest deterministic prefix of the pipeline; the random suffix runs on each sample as it
    is read.

    Args:
        folder: the dataset's folder; or, where its format is ``webdataset``, its URL (``s3://bucket/set``, by fsspec),
            which :class:`StreamedCloudDataset` goes through with few requests: here every sample is one.
        pipeline: the pipeline you expect; a cache made by other deterministic steps is refused. None = trust the
            cache's own.
        augment: what runs on the stored clouds: "stored" = the random suffix of the pipeline, None = nothing, or any
            transform.
        seed: of all random draws, together with the epoch and the sample id.
        repeats: how often every sample is in the dataset, each time with other random draws.
        split: the samples of one split alone, such as "train"; see :func:`pcdata.split_dataset`. None = all.
        splits: the file that says which those are; None = ``splits.json`` of the dataset.
        storage_options: of a URL, what fsspec's file system takes, such as ``{"anon": True}``.

    Raises:
        CacheError: damaged, hostile or incomplete files, another pipeline's cache, or no splits of these samples.
        ConfigError: there is no such split.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        pipeline: Compose | None = None,
        augment: Transform | Literal["stored"] | None = "stored",
        seed: int = 0,
        repeats: int = 1,
        split: str | None = None,
        splits: str | Path | None = None,
        storage_options: Mapping[str, Any] | None = None,
    ) -> None:
        if isinstance(augment, str) and augment != "stored":
            raise ConfigError(f"augment must be 'stored', None or a transform, got {augment!r}")
        if pipeline is not None and not isinstance(pipeline, Compose):
            raise DTypeError(
                f"pipeline must be a Compose, not {type(pipeline).__name__}; of a configuration file it is "
                "pcdata.load_config(path).pipeline"
            )
        self.folder, server = Path(folder), None
        if isinstance(folder, str) and ":" in folder:
            self.folder, server = opened_folder("CachedCloudDataset", folder, storage_options)
        self._shown: object = self.folder if server is None else server  # as messages call it
        self.manifest = Manifest.read(self.folder)
        stored = self._stored_pipeline()
        self._warn_of_other_files()
        wanted = stored if pipeline is None else pipeline
        fingerprint = wanted.stored_fingerprint()
        if fingerprint != self.manifest.fingerprint:
            raise CacheError(
                f"{self._shown}: the cache was made by other deterministic steps than the ones given "
                f"(fingerprint {self.manifest.fingerprint[:12]}, expected {fingerprint[:12]}): "
                f"{wanted.difference(stored)}; rebuild it with this pipeline, or load it with its own"
            )
        self.pipeline = wanted
        transform = wanted.split()[1] if isinstance(augment, str) else augment
        ids: Sequence[str] = self.manifest.index.ids
        self.split = split
        self.splits = self.folder / SPLITS if splits is None else Path(splits)
        if split is not None and splits is None and server is not None:
            fetch(server, self.folder, SPLITS)
        self._rows: NDArray[np.int64] | None = None  # of the samples in the index; None = all
        if split is not None:
            rows = Splits.read(self.splits, ids).rows(split, ids)
            self._rows = np.array(rows, dtype=np.int64)
            ids = [ids[row] for row in rows]
        elif splits is not None:
            raise ConfigError(f"splits {str(splits)!r} say nothing without split, such as split='train'")
        super().__init__(ids, transform, seed, repeats)
        form, index = self.manifest.format, self.manifest.index
        self._shards = (
            Shards(self.folder, form, index) if server is None else UrlShards(server, self.folder, form, index)
        )
        self._touched = FirstTouch(self.manifest.index)
        self._forms = CloudForms()

    def _stored_pipeline(self) -> Compose:
        try:
            return Compose.from_config(self.manifest.pipeline)
        except (ConfigError, RecursionError) as error:
            raise CacheError(
                f"{self.folder / FILE_NAME}: its pipeline cannot be built: {error}{self._own_steps()}, or rebuild the "
                "dataset"
            ) from error

    def _own_steps(self) -> str:
        """Say which files have the steps that are not pcdata's."""
        files = [f"{one['file']} (sha256 {one['sha256'][:12]})" for one in self.manifest.imports if one["transforms"]]
        if not files:
            return "; import the modules that define your own transforms before you load it"
        return (
            f"; it was built with steps from {', '.join(files)}: say where that is, with --import FILE.py or "
            "pcdata.import_file(path)"
        )

    def _warn_of_other_files(self) -> None:
        """Warn where a file that was imported defines the same steps, and is not the one of the build."""
        known = {file.sha256 for file in imported_files()}
        mine = {name: file for file in imported_files() for name in file.transforms}
        for one in self.manifest.imports:
            others = {mine[name].name for name in one["transforms"] if name in mine}
            if others and one["sha256"] not in known:
                warnings.warn(
                    f"{self._shown}: was built with another {one['file']} (sha256 {one['sha256'][:12]}) than the "
                    f"{', '.join(sorted(others))} that is imported; rebuild it if its steps have changed",
                    PcdataWarning,
                    stacklevel=4,
                )

    def shard_of(self, number: int) -> Path:
        """Return the folder of the shard that one sample lies in."""
        return shard_folder(self.folder, int(self.manifest.index.shards[number]))

    @property
    def episodes(self) -> list[Episode]:
        """The episodes over ``ids``, as the build kept them."""
        own = self.manifest.episodes
        return list(own) if self._rows is None else kept_episodes(own, self._rows.tolist())

    def signal_table(self) -> Mapping[str, Signal]:
        """Return the signals of all samples by name, (S, ...) in the order of ``ids``, as recorded; no cloud is loaded.

        Raises:
            ShapeError: the samples had not all the same signals when they were built.
            CacheError: damaged or hostile files.
        """
        told = self.manifest.signals
        if "fault" in told:
            raise ShapeError(f"{self._shown}: its samples have no signals in common: {told['fault']}; build it again")
        if "digest" not in told:
            return {}
        record, path = self._shards.signals(), self._shards.signals_store().place_of(SIGNALS_KEY)
        if record.digest() != told["digest"]:
            raise CacheError(f"{path}: the signals differ from what was written; rebuild the dataset")
        try:
            table = signals_from_record(record, len(self.manifest.index))
        except CacheError as error:
            raise CacheError(f"{path}: {error}; rebuild the dataset") from error
        if self._rows is None:
            return table
        rows = torch.from_numpy(self._rows)
        return {name: signal.rows(rows) for name, signal in table.items()}

    def _rows_of(self, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return which samples of the index some samples are."""
        return numbers if self._rows is None else self._rows[numbers]

    def _load(self, index: int) -> PointCloud:
        rows = self._rows_of(np.array([index]))
        row = int(rows[0])
        with self._shards.held(rows):
            if self._compared(rows):
                record = self._shards.read_joined(rows) or self._shards.read(row)
            else:
                record = self._shards.read(row)
                self._check_digest(row, record.digest())
        try:
            cloud = cloud_from_record(record)
        except CacheError as error:
            raise self._fault(row, f": {error}") from error
        wanted = int(self.manifest.index.num_points[row])
        if cloud.num_points != wanted:
            raise self._fault(row, f" has {cloud.num_points} points, but the index says {wanted}")
        return cloud

    def _compared(self, rows: NDArray[np.int64]) -> bool:
        """Compare the digests of samples that nobody has read yet; False where every read must compare its own."""
        if self._touched.has_all(rows, self._shards.closed):
            return True
        files = self._shards.identities(rows)
        if files is None:
            return False
        for fresh in self._touched.fresh(rows, files):
            self._check_digest(fresh, self._shards.digest(fresh))
            self._touched.note(fresh)
        return True

    def _check_digest(self, row: int, digest: str) -> None:
        if digest != self.manifest.index.digest(row):
            raise self._fault(row, " differs from what was written")

    def _fault(self, row: int, what: str) -> CacheError:
        path = self._shards.place_of(row)
        error = CacheError(f"{path}: sample {self.manifest.index.ids[row]!r}{what}; rebuild the dataset")
        locate(error, path=path)
        return error

    def _load_at_once(
        self, numbers: NDArray[np.int64], *, leave: Collection[str] = ()
    ) -> tuple[PointCloud | None, Mapping[str, Tensor] | None]:
        """Return the clouds of some samples as one batch; None where that of one by one would be another.

        And where the rows of fields lie, if they were left there: of the fields to ``leave`` they may.
        """
        rows = self._rows_of(numbers)
        sources: Mapping[str, Tensor] | None = None
        with self._shards.held(rows):
            record = None
            if self._compared(rows):
                record = self._shards.read_joined(rows, batch_memory, leave=leave)
        if record is None:
            single = [self._load(number) for number in numbers.tolist()]
            if any(one.frames.keys() != single[0].frames.keys() for one in single):
                return None, None
            clouds = PointCloud.cat(single)
        else:
            clouds = self._forms.cloud(record)
            if record.sources is not None:
                sources = {name: torch.from_numpy(addresses) for name, addresses in record.sources.items()}
        # One cloud each, since none has fewer.
        ptr, wanted = clouds.ptr.numpy(), self.manifest.index.num_points[rows]
        fits = len(ptr) == len(wanted) + 1 and bool((ptr[1:] - ptr[:-1] == wanted).all())
        return (clouds, sources) if fits else (None, None)

    def _made_at_once(self, numbers: NDArray[np.int64], streams: Streams | None) -> Unbatched | None:
        if not runs_on_batches(self.transform):
            return None
        batches = []
        chain = self.transform if type(self.transform) is Compose and len(self.transform) else None
        leave = () if chain is None else chain.fields_read_once
        for part in self._parts(numbers):
            clouds, sources = self._load_at_once(numbers[part], leave=leave)
            if clouds is None:
                return None
            own = None if streams is None else streams.part(part)
            if chain is not None:  # the clouds were read for this batch alone
                batches.append(chain.consume(clouds, generator=own, sources=sources))
            else:
                batches.append(self._transformed(clouds, own))
        return Unbatched(batches)

    @functools.cached_property
    def _largest(self) -> int:
        """The points of the largest sample."""
        return int(self.manifest.index.num_points.max(initial=0))

    def _parts(self, numbers: NDArray[np.int64], each: int = 1) -> Iterator[slice]:
        """Cut samples, ``each`` of which belong together, into parts that the memory of a processor can hold."""
        if len(numbers) * self._largest <= _MOST_POINTS:
            yield slice(0, len(numbers))
            return
        counts = self.manifest.index.num_points[self._rows_of(numbers)]
        begin = points = 0
        for place, own in enumerate(counts.reshape(-1, each).sum(axis=1).tolist()):
            if points and points + own > _MOST_POINTS:
                yield slice(begin, place * each)
                begin, points = place * each, 0
            points += own
        yield slice(begin, len(numbers))

    def __repr__(self) -> str:
        split = "" if self.split is None else f" of {self.split}"
        return f"CachedCloudDataset({str(self._shown)!r}, {len(self)} samples{split}, {self.manifest.format})"
