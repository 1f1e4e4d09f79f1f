"""Is a dataset what was written: every byte of it is hashed again and compared."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from pcdata.build.card import CROISSANT, README
from pcdata.build.card_answers import FILE_NAME as ANSWERS
from pcdata.build.card_answers import CardAnswers
from pcdata.build.contents import foreign_files
from pcdata.build.written_texts import FILE_NAME as TEXTS
from pcdata.build.written_texts import written_texts
from pcdata.contracts.numbers import whole_number
from pcdata.datasets.splits import FILE_NAME as SPLITS
from pcdata.datasets.splits import Splits
from pcdata.errors import CacheError, ConfigError
from pcdata.files.opening import read_bytes
from pcdata.files.strict_json import json_object
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

_MAX_BYTES = 1 << 28  # of a card
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
        num_files: of the shards, that were hashed.
        num_bytes: of these files.
        faults: one for each file that is not what was written; none = all is.
        notes: what is no fault, in words: texts that were edited by hand, a card that tells of other splits.
    """

    folder: Path
    num_files: int
    num_bytes: int
    faults: list[DatasetFault] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def verify_dataset(folder: str | Path, *, workers: int = 1, progress: Progress | None = None) -> DatasetVerdict:
    """Hash every file of a built dataset again, and say which are damaged, missing or foreign.

    ``dataset.json`` has a checksum of itself and tells the index, which tells the table of every shard, which tells its
    files. Where a file holds many samples, each is read to find those that differ. ``splits.json`` has a checksum of
    itself. The texts beside (``README.md``, ``croissant.json``, ``load.py``, ``pipeline.yaml``) may be edited: that is
    noted, and no fault.

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
        self.notes: list[str] = []
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
        self._check_splits()
        self._check_texts()
        for path in foreign_files(self.folder, self.manifest, self.tables):
            self._add(path, "foreign", "no build wrote it", ())
        self._tell(self.manifest.index.num_shards)
        self.faults.sort(key=lambda fault: fault.path)
        return DatasetVerdict(self.folder, files, num_bytes, self.faults, self.notes)

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

    def _check_splits(self) -> None:
        if os.path.lexists(self.folder / SPLITS):
            try:
                Splits.read(self.folder, self.manifest.index.ids)
            except CacheError as error:
                self._add(SPLITS, "damaged", str(error), ())

    def _check_texts(self) -> None:
        try:
            texts = written_texts(self.folder)
            if not texts:
                self._add(TEXTS, "missing", "is not there, so edits of the texts beside it cannot be told", ())
        except CacheError as error:
            self._add(TEXTS, "damaged", str(error), ())
            return
        for name, same in texts.items():
            if same is None:
                how = "; 'pcdata card DATASET' writes it anew" if name in (README, CROISSANT) else ""
                self._add(name, "missing", f"is not there{how}", ())
            elif not same:
                self.notes.append(f"{name} was edited by hand")
        if texts.get(CROISSANT) and self._tells_of_other_splits():
            self.notes.append(f"the card tells of other splits than {SPLITS}; 'pcdata card DATASET' writes it anew")
        if os.path.lexists(self.folder / ANSWERS):
            try:
                CardAnswers.read(self.folder / ANSWERS)
            except ConfigError as error:
                self._add(ANSWERS, "damaged", str(error), ())

    def _tells_of_other_splits(self) -> bool:
        path = self.folder / SPLITS
        own = hash_of(path)[1] if path.is_file() else None
        card = self.folder / CROISSANT
        data = read_bytes("verify", card, max_bytes=_MAX_BYTES, error=CacheError)
        content = json_object(str(card), data, error=CacheError)  # as it was written
        return own != next((one["sha256"] for one in content["distribution"] if one["name"] == SPLITS), None)

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
