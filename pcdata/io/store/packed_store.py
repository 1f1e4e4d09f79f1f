"""Datasets made for training: the arrays of all clouds end to end in one file that is mapped into memory."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CacheError
from pcdata.io.store.cloud_record import Record, Room
from pcdata.io.store.joined_record import merged_info, own_info, split_info
from pcdata.io.store.packed_batches import HISTORY, PackedBatches
from pcdata.io.store.packed_file import PackedFile, open_packed
from pcdata.io.store.packed_writer import PackedWriter
from pcdata.io.store.store import INFO, Compression, Store, damage_named, register_store, writing
from pcdata.io.store.text_table import TextTable


@register_store
class _PackedStore(Store):
    """``clouds.packed``: see :mod:`pcdata.io.store.packed_file` for its bytes.

    It is written once, from the first record to :meth:`close`; it is opened once in every process, and what is checked
    then, its end and its tables, is not checked again. Records are read by copying their rows out of the mapped file,
    all records of a batch into one array of each field.
    """

    format = "packed"
    compressions = ("none",)
    suffix = ".packed"

    def __init__(self, folder: str | Path, compression: Compression = "none") -> None:
        super().__init__(folder, compression)
        self.path = self.folder / "clouds.packed"
        self._writer: PackedWriter | None = None
        self._opened_file: PackedFile | None = None

    def path_of(self, key: str) -> Path:
        """Return the one file that holds all records."""
        return self.path

    def write(self, key: str, record: Record) -> None:
        """Add one record; it is on disk after :meth:`close`."""
        common, *texts = split_info(record)
        text, history = (np.frombuffer(one.encode(), np.uint8) for one in texts)
        with writing(self.path):
            writer, self._writer = self._writer or PackedWriter(self.path), None
            writer.add(key, common, {**record.arrays, INFO: text, HISTORY: history})
            self._writer = writer  # one that failed is not gone on with

    def close(self) -> None:
        """Force what was written to disk, or forget the mapped file of this process."""
        writer, self._writer, self._opened_file = self._writer, None, None
        if writer is not None:
            with writing(self.path):
                writer.finish()

    def read(self, key: str) -> Record:
        """Read one record; its arrays are the caller's own."""
        with damage_named(self.path):
            record = self._as_it_lies(key)
            return Record({name: array.copy() for name, array in record.arrays.items()}, record.info)

    def digest(self, key: str) -> str:
        """Return the digest of one record, computed where it lies."""
        with damage_named(self.path):
            return self._as_it_lies(key).digest()

    @classmethod
    def batch_reader(cls) -> _Reader:
        """Return what reads records of one file, or of several, as one; every array is copied once."""
        return _Reader()

    def identity(self) -> tuple[int, ...]:
        """Return what tells the mapped file from another of its name."""
        with damage_named(self.path):
            return self._mapped().identity

    def _as_it_lies(self, key: str) -> Record:
        """Return a record whose arrays are those of the mapped file."""
        file = self._mapped()
        facts, arrays = file.record(file.number_of(key))
        own, history = (arrays.pop(name, None) for name in (INFO, HISTORY))
        if own is None or history is None or own.dtype != np.uint8 or history.dtype != np.uint8:
            raise CacheError(f"has a record without the texts {INFO!r} and {HISTORY!r}")
        info = merged_info(facts, own_info(own.tobytes(), history.tobytes()))
        if "meta" in info and "ptr" in arrays and len(info["meta"]) != arrays["ptr"].size - 1:  # of signals alone: none
            raise CacheError(f"meta must be a list with one object per cloud, got {info['meta']!r:.100}")
        return Record(arrays, info)

    def _mapped(self) -> PackedFile:
        if self._writer is not None:
            raise CacheError(f"{self.path}: is being written; close the store, then read")
        if self._opened_file is None:
            with self._opened(self.path) as file:
                self._opened_file = open_packed(file)
        return self._opened_file

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_writer": None, "_opened_file": None}


class _Reader:
    """Reads batches of the files that stores have mapped."""

    def __init__(self) -> None:
        self._batches = PackedBatches()

    def places(self, store: _PackedStore, keys: TextTable) -> NDArray[np.int64]:
        """Return where records lie."""
        with damage_named(store.path):
            file = store._mapped()
            first = self._batches.places_in(file)
            if file.keys == keys:  # as builds write them
                return np.arange(first, first + len(keys))
            numbers = {key: number for number, key in enumerate(file.keys, start=first)}
            return np.array([numbers.get(key, -1) for key in keys], dtype=np.int64)

    def read(
        self, places: NDArray[np.int64], room: Room | None = None, *, leave: Collection[str] = ()
    ) -> Record | None:
        """Return the record of all clouds."""
        return self._batches.read(places, room, leave=leave)
