"""Is a dataset what was written: every byte of it is hashed again and compared."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from pcdata.build.contents import foreign_files
from pcdata.contracts.numbers import whole_number
from pcdata.errors import CacheError, ConfigError
from pcdata.io.store.manifest import FILE_NAME, Manifest
from pcdata.io.store.sample_keys import key_of
from pcdata.io.store.shards import (
    SIGNALS_FOLDER,
    TABLE,
    Shards,
    StoredFile,
    hash_of,
    hashes_below,
    read_table,
    shard_folder,
)
from pcdata.io.store.stores import STORES
from pcdata.progress import Progress

_AT_ONCE = 4096  # files that wait for a worker: what is known of them is memory


@dataclass(frozen=True)
class DatasetFault:
    """A file of a dataset that is not what was written.

    Args:
        path: of the file, from the dataset's folder.
        kind: "damaged", "missing", or "foreign" where no build wrote it.
        why: what was found, in words.
        samples: the ids of the samples whose clouds or captures cannot be trusted; () = none.
    """

    path: str
    kind: Literal["damaged", "missing", "foreign"]
    why: str
    samples: tuple[str, ...] = ()


@dataclass(frozen=True)
class DatasetVerdict:
    """What :func:`verify_dataset` found.

    Args:
        folder: of the dataset.
        num_files: that were hashed.
        num_bytes: of these files.
        faults: one for each file that is not what was written; none = all is.
    """

    folder: Path
    num_files: int
    num_bytes: int
    faults: list[DatasetFault] = field(default_factory=list)


def verify_dataset(folder: str | Path, *, workers: int = 1, progress: Progress | None = None) -> DatasetVerdict:
    """Hash every file of a built dataset again, and say which are damaged, missing or foreign.

    ``dataset.json`` has a checksum of itself and tells the index, which tells the table of every shard, which tells its
    files. The texts that a build writes beside (``load.py``, ``pipeline.yaml``) may be edited and are not compared.
    Where a file holds many samples, each is read to find those that differ.

    Args:
        folder: of the dataset.
        workers: how many files are hashed at a time.
        progress: called after every shard.

    Raises:
        ConfigError: ``workers`` is below 1.
        CacheError: there is no dataset in the folder, or it cannot be examined.
    """
    workers = whole_number("verify_dataset", "workers", workers)
    if workers < 1:
        raise ConfigError(f"verify_dataset: workers must be 1 or more, got {workers}")
    folder = Path(folder)
    if not (folder / FILE_NAME).is_file():
        Manifest.read(folder)  # says what is there instead
    try:
        manifest = Manifest.read(folder)
    except CacheError as error:
        why = f"{error}; without it nothing else can be compared"
        return DatasetVerdict(folder, 1, 0, [DatasetFault(_relative(folder, error), "damaged", why)])
    return _Verification(folder, manifest, progress).run(workers)


class _Verification:
    def __init__(self, folder: Path, manifest: Manifest, progress: Progress | None) -> None:
        self.folder = folder
        self.manifest = manifest
        self.progress = progress
        self.shards = Shards(folder, manifest.format, manifest.index)
        self.faults: list[DatasetFault] = []
        self.tables: dict[int, set[str]] = {}  # the names of the files of every shard whose table is right

    def run(self, workers: int) -> DatasetVerdict:
        files = num_bytes = done = 0
        planned = self._planned()
        with ThreadPoolExecutor(workers) as pool:
            while part := list(itertools.islice(planned, _AT_ONCE)):
                for (shard, name, told), found in zip(part, pool.map(self._examined, part)):
                    files, num_bytes = files + 1, num_bytes + told.size
                    if found is not None:
                        self._add(self._place(shard, name), *found, self._samples_in(shard, name))
                    if shard > done:
                        done = self._tell(shard)
        self._check_signals()
        for path in foreign_files(self.folder, self.manifest, self.tables):
            self._add(path, "foreign", "no build wrote it", ())
        self._tell(self.manifest.index.num_shards)
        self.faults.sort(key=lambda fault: fault.path)
        return DatasetVerdict(self.folder, files, num_bytes, self.faults)

    def _planned(self) -> Iterator[tuple[int, str, StoredFile]]:
        """Give the files that the tables of the shards tell of."""
        index = self.manifest.index
        for shard in range(index.num_shards):
            try:
                table = read_table(self.folder, shard, index.tables[shard].tobytes())
            except CacheError as error:
                path = shard_folder(self.folder, shard) / TABLE
                kind: Literal["damaged", "missing"] = "damaged" if os.path.lexists(path) else "missing"
                self._add(self._place(shard, TABLE), kind, str(error), self._differing(shard))
                continue
            self.tables[shard] = {TABLE, *table}
            for name, told in table.items():
                yield shard, name, told

    def _examined(self, one: tuple[int, str, StoredFile]) -> tuple[Literal["damaged", "missing"], str] | None:
        shard, name, told = one
        path = shard_folder(self.folder, shard) / name
        if not os.path.lexists(path):
            return "missing", "is not there"
        if path.is_symlink():
            return "damaged", "is a link, which no build writes"
        try:
            size, sha256 = hash_of(path)
        except (CacheError, OSError) as error:
            return "damaged", str(error)
        if size != told.size:
            return "damaged", f"has {size} bytes, but {told.size} were written"
        return None if sha256 == told.sha256 else ("damaged", "its bytes are not those that were written")

    def _samples_in(self, shard: int, name: str) -> tuple[str, ...]:
        """Return the ids of the samples that a bad file spoils."""
        index, folder = self.manifest.index, shard_folder(self.folder, shard)
        numbers = index.of_shard(shard)
        top, _, below = name.partition("/")
        if top == "raw":
            keys = {below.partition("/")[0]}
            return tuple(index.ids[number] for number in numbers if key_of(index.ids[number]) in keys)
        own = [number for number in numbers if self.shards.path_of(number) == folder / name]
        return self._differing(shard) if len(own) > 1 else tuple(index.ids[number] for number in own)

    def _differing(self, shard: int) -> tuple[str, ...]:
        """Return the ids of the samples of a shard whose records are not what was written."""
        index, found = self.manifest.index, []
        store = STORES[self.manifest.format](shard_folder(self.folder, shard))
        for number in index.of_shard(shard):
            try:
                right = store.digest(key_of(index.ids[number])) == index.digest(number)
            except CacheError:
                right = False
            if not right:
                found.append(index.ids[number])
        store.close()
        return tuple(found)

    def _check_signals(self) -> None:
        told = self.manifest.signals.get("digest")
        if told is None:
            return
        try:
            found = hashes_below(self.folder / SIGNALS_FOLDER)
            if self.shards.signals().digest() != told:
                raise CacheError("the signals differ from what was written")
        except CacheError as error:
            self._add(SIGNALS_FOLDER, "damaged", str(error), ())
            return
        for name, written in self.manifest.signals_files.items():
            if name in found and found[name] != written:
                why = "its bytes are not those that were written"
                self._add(f"{SIGNALS_FOLDER}/{name}", "damaged", why, ())

    def _tell(self, shards: int) -> int:
        """Say how many shards are done."""
        if self.progress is not None:
            self.progress(shards, self.manifest.index.num_shards, f"shard {shards - 1:05d}")
        return shards

    def _place(self, shard: int, name: str) -> str:
        return (shard_folder(self.folder, shard) / name).relative_to(self.folder).as_posix()

    def _add(
        self, path: str, kind: Literal["damaged", "missing", "foreign"], why: str, samples: tuple[str, ...]
    ) -> None:
        self.faults.append(DatasetFault(path, kind, why, samples))


def _relative(folder: Path, error: CacheError) -> str:
    """Return the file that an error is about, from the dataset's folder."""
    path = Path(getattr(error, "path", None) or folder / FILE_NAME)
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else FILE_NAME
