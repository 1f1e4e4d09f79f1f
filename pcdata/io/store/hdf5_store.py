"""Datasets as one HDF5 file with a group per sample."""

from __future__ import annotations

import os
import weakref
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from pcdata.errors import CacheError
from pcdata.files.interrupts import shielded
from pcdata.io.arrays.hdf5_arrays import hard_linked, open_hdf5, read_group
from pcdata.io.arrays.hdf5_writing import FaultKeepingFile
from pcdata.io.store.cloud_record import Record, parse_info
from pcdata.io.store.store import INFO, Compression, Store, damage_named, register_store, writing

_TABLES = 1 << 20  # bytes of HDF5's own tables kept in memory while a file is written

_INHERITED: list[Any] = []


@register_store
class Hdf5Store(Store):
    """``clouds.h5``: a group per sample with its arrays and the JSON text as datasets."""

    format = "hdf5"
    compressions = ("none", "lzf", "gzip")
    suffix = ".h5"
    holds_file = True

    def __init__(self, folder: str | Path, compression: Compression = "none") -> None:
        super().__init__(folder, compression)
        self.path = self.folder / "clouds.h5"
        self._file: Any = None
        self._opened_by = 0
        self._disk: FaultKeepingFile | None = None  # under a file that is written
        self._at_exit: weakref.finalize | None = None  # closes a file that is written and left open

    def path_of(self, key: str) -> Path:
        """Return the one file that holds all records."""
        return self.path

    def write(self, key: str, record: Record) -> None:
        """Append one group."""
        # HDF5 calls back into Python, where a signal must not raise.
        with writing(self.path), shielded():
            file, disk = self._open_to_write()
            try:
                _write_group(file.create_group(key), record, self.compression)
            finally:
                if disk.has_failed:
                    with suppress(CacheError):  # raised below
                        self.close()
                disk.check()

    def read(self, key: str) -> Record:
        """Read one group."""
        import h5py

        with damage_named(self.path):
            if self._opened_by != os.getpid() or self._file is None:
                self._opened(self.path).close()
            group = hard_linked(self._open("r"), key)
            if group is None:
                raise CacheError(f"has no group {key!r}")
            if not isinstance(group, h5py.Group):
                raise CacheError(f"{key!r} must be a group, not a {type(group).__name__}")
            arrays = read_group(group, self.path.stat().st_size)
            if INFO not in arrays:
                raise CacheError(f"group {key!r} has no dataset {INFO!r}")
            return Record(arrays, parse_info(bytes(arrays.pop(INFO))))

    def close(self) -> None:
        """Force what was written to disk and close the handle of this process."""
        file, self._file = self._file, None
        if self._at_exit is not None:
            self._at_exit.detach()
        if file is None:
            return
        if self._opened_by != os.getpid():
            _INHERITED.append(file)
            return
        with writing(self.path), shielded():
            try:
                file.close()
            finally:
                disk, self._disk = self._disk, None
                if disk is not None:
                    disk.close()

    def _open_to_write(self) -> tuple[Any, FaultKeepingFile]:
        import h5py

        if self._file is None or self._disk is None or self._opened_by != os.getpid():
            self.close()
            self.folder.mkdir(parents=True, exist_ok=True)
            disk = FaultKeepingFile(self.path)
            self._file = h5py.File(disk, "w" if disk.is_new else "r+")
            self._disk, self._opened_by = disk, os.getpid()
            self._at_exit = weakref.finalize(self, _close_written, self._file, disk, self._opened_by)
            # What was written is not read again: the library's own limit of 32 MB of tables is memory for nothing.
            cache = self._file.id.get_mdc_config()
            cache.set_initial_size, cache.initial_size = True, _TABLES
            cache.min_size, cache.max_size = _TABLES, _TABLES
            self._file.id.set_mdc_config(cache)
        return self._file, self._disk

    def _open(self, mode: str) -> Any:
        if self._file is None or self._opened_by != os.getpid():
            # A handle that came through fork shares its file position with the parent: never use or close it here.
            if self._file is not None:
                _INHERITED.append(self._file)
            self._file = open_hdf5(self.path, mode)
            self._opened_by = os.getpid()
        return self._file

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_file": None, "_opened_by": 0, "_disk": None, "_at_exit": None}


def _close_written(file: Any, disk: FaultKeepingFile, opened_by: int) -> None:
    """Close a file that a store left open: HDF5 ends after Python, when it can call no file object any more."""
    if os.getpid() == opened_by:
        with suppress(OSError, RuntimeError):
            file.close()
        with suppress(OSError):
            disk.close()


def _write_group(group: Any, record: Record, compression: Compression) -> None:
    for name, array in record.arrays.items():
        # One chunk per array: a sample is always read whole.
        packed = compression != "none" and array.size > 0
        options = {"compression": compression, "shuffle": True, "chunks": array.shape} if packed else {}
        group.create_dataset(name, data=array, track_times=False, **options)
    # A dataset, not an attribute: attributes end at 64 KB and a history may be longer.
    group.create_dataset(INFO, data=np.bytes_(record.info_text().encode()), track_times=False)
    for name in ("frame_id", "unit"):
        group.attrs[name] = record.info[name]
