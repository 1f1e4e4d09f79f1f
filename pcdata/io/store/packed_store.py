"""Datasets made for training: the arrays of all clouds end to end in one file that is mapped into memory."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CacheError
from pcdata.io.store.cloud_record import DERIVED, Record, Room
from pcdata.io.store.joined_record import joined_record, merged_info, own_info, split_info
from pcdata.io.store.packed_file import PackedFile, PackedWriter, Place, join_rows, open_packed
from pcdata.io.store.store import INFO, Compression, Store, damage_named, register_store, writing

_HISTORY = f"{INFO}.history"  # apart from the other facts: it is long, and seldom read


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
            writer.add(key, common, {**record.arrays, INFO: text, _HISTORY: history})
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
            file = self._mapped()
            record = _as_it_lies(file.place_of(key))
            return Record({name: array.copy() for name, array in record.arrays.items()}, record.info)

    def digest(self, key: str) -> str:
        """Return the digest of one record, computed where it lies."""
        with damage_named(self.path):
            file = self._mapped()
            return _as_it_lies(file.place_of(key)).digest()

    @classmethod
    def read_joined(cls, records: Sequence[tuple[Store, str]], room: Room | None = None) -> Record | None:
        """Read records, of one file or several, as one; every array is copied once."""
        places: list[Place] = []
        store: Store | None = None
        try:
            for store, key in records:
                assert isinstance(store, _PackedStore)
                places.append((store._opened_file or store._mapped()).place_of(key))
        except Exception:
            with damage_named(records[len(places)][0].path_of("")):
                raise
        with damage_named(records[0][0].path_of("")):
            joined = join_rows(places, DERIVED, room)
            if joined is None:
                return None
            arrays, rows = joined
            own, history = (_texts(arrays.pop(name), rows.pop(name)) for name in (INFO, _HISTORY))
            # The strict parser looked at each when its digest was compared.
            owns = json.loads(b"[" + b",".join(own) + b"]")
            return joined_record(arrays, rows, places[0].facts, owns, history)

    def identity(self) -> tuple[int, ...]:
        """Return what tells the mapped file from another of its name."""
        with damage_named(self.path):
            return self._mapped().identity

    def _mapped(self) -> PackedFile:
        if self._writer is not None:
            raise CacheError(f"{self.path}: is being written; close the store, then read")
        if self._opened_file is None:
            with self._opened(self.path) as file:
                self._opened_file = open_packed(file)
        return self._opened_file

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_writer": None, "_opened_file": None}


def _as_it_lies(place: Place) -> Record:
    """Return a record whose arrays are those of the mapped file."""
    arrays = place.arrays()
    own, history = (arrays.pop(name, None) for name in (INFO, _HISTORY))
    if own is None or history is None or own.dtype != np.uint8 or history.dtype != np.uint8:
        raise CacheError(f"has a record without the texts {INFO!r} and {_HISTORY!r}")
    return Record(arrays, merged_info(place.facts, own_info(own.tobytes(), history.tobytes())))


def _texts(letters: NDArray[Any], counts: NDArray[np.int64]) -> list[bytes]:
    ends = counts.cumsum().tolist()
    together = letters.tobytes()
    return [together[begin:end] for begin, end in zip([0, *ends], ends)]
