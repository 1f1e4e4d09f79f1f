"""Datasets as a folder of ``.npz`` files, readable with ``numpy.load``."""

from __future__ import annotations

import numpy as np

from pcdata.errors import CacheError
from pcdata.files.npz import array_names, read_array, write_npz
from pcdata.files.packing import check_packing
from pcdata.io.store.cloud_record import Record, parse_info
from pcdata.io.store.store import INFO, Store, damage_named, register_store, synced


@register_store
class NpzStore(Store):
    """``clouds/<key>.npz``, readable with ``numpy.load``."""

    format = "npz"
    compressions = ("none", "gzip")
    suffix = ".npz"

    def write(self, key: str, record: Record) -> None:
        """Write one file."""
        with synced(self.path_of(key)) as file:
            arrays = {**record.arrays, INFO: np.array(record.info_text())}
            write_npz(file, arrays, compressed=self.compression != "none")

    def read(self, key: str) -> Record:
        """Read one file."""
        path = self.path_of(key)
        with damage_named(path), self._archive(path) as archive:
            members = array_names(archive)
            check_packing("it", sum(member.size for member in members.values()), archive.size)
            arrays = {name: read_array(archive, member) for name, member in members.items()}
            if INFO not in arrays:
                raise CacheError(f"has no member {INFO!r}")
            return Record(arrays, parse_info(str(arrays.pop(INFO))))
