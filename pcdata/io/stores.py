"""Where records live: one HDF5 file with a group per sample, or a folder of .npz or .pt files.

Readers hold a path, not a handle: files are opened on first use in each process, so a dataset may be pickled, forked or
spawned at any time. Nothing is ever unpickled, and sizes that a file claims are checked against what it holds.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch

from pcdata.errors import CacheError
from pcdata.io.record import Record, parse_info

Format = Literal["hdf5", "npz", "pt"]
Compression = Literal["none", "lzf", "gzip"]

INFO = "pcdata"  # the name that the JSON text is stored under

# Deflate cannot pack tighter than 1032:1, LZF not tighter than 100:1; a larger claim is a bomb or a damaged header.
_MAX_RATIO = 1100


class Store:
    """Records by key inside one dataset folder."""

    suffix: ClassVar[str]

    def __init__(self, folder: str | Path, compression: Compression = "none") -> None:
        self.folder = Path(folder)
        self.compression = compression

    def write(self, key: str, record: Record) -> None:
        """Add one record; keys are file-name safe and unique."""
        raise NotImplementedError

    def read(self, key: str) -> Record:
        """Read one record.

        Raises:
            CacheError: missing, damaged or hostile; says which file.
        """
        raise NotImplementedError

    def close(self) -> None:
        """Flush to disk and close any handle of this process."""


class NpzStore(Store):
    """``clouds/<key>.npz``, readable with ``numpy.load``."""

    suffix = ".npz"

    def write(self, key: str, record: Record) -> None:
        """Write one file."""
        save = np.savez if self.compression == "none" else np.savez_compressed
        path = _file_of(self, key)
        with _synced(path) as file:
            arrays: dict[str, Any] = {**record.arrays, INFO: np.array(record.info_text())}
            save(file, allow_pickle=False, **arrays)

    def read(self, key: str) -> Record:
        """Read one file."""
        path = _file_of(self, key)
        with _damage_named(path):
            with zipfile.ZipFile(path) as archive:
                for member in archive.infolist():
                    _check_npz_member(archive, member)
            with np.load(path, allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files if name != INFO}
                return Record(arrays, parse_info(str(stored[INFO])))


class PtStore(Store):
    """``clouds/<key>.pt``: a dict of tensors and one JSON text, loads with ``weights_only=True``."""

    suffix = ".pt"

    def write(self, key: str, record: Record) -> None:
        """Write one file."""
        # A tensor that is a view would drag its whole storage into the file: copy.
        tensors: dict[str, Any] = {name: torch.from_numpy(array).clone() for name, array in record.arrays.items()}
        with _synced(_file_of(self, key)) as file:
            torch.save({**tensors, INFO: record.info_text()}, file)

    def read(self, key: str) -> Record:
        """Read one file."""
        path = _file_of(self, key)
        with _damage_named(path):
            stored = torch.load(path, weights_only=True, map_location="cpu")
            if not isinstance(stored, dict) or not isinstance(stored.get(INFO), str):
                raise CacheError(f"must hold a dict with tensors and a text {INFO!r}")
            arrays = {name: value.numpy() for name, value in stored.items() if isinstance(value, torch.Tensor)}
            return Record(arrays, parse_info(stored[INFO]))


class Hdf5Store(Store):
    """``clouds.h5``: a group per sample with its arrays and the JSON text as datasets."""

    suffix = ".h5"

    def __init__(self, folder: str | Path, compression: Compression = "none") -> None:
        super().__init__(folder, compression)
        self.path = self.folder / "clouds.h5"
        self._file: Any = None
        self._opened_by = 0

    def write(self, key: str, record: Record) -> None:
        """Append one group."""
        group = self._open("a").create_group(key)
        for name, array in record.arrays.items():
            # One chunk per array: a sample is always read whole.
            packed = self.compression != "none" and array.size > 0
            options = {"compression": self.compression, "shuffle": True, "chunks": array.shape} if packed else {}
            group.create_dataset(name, data=array, track_times=False, **options)
        # A dataset, not an attribute: attributes end at 64 KB and a history may be longer.
        group.create_dataset(INFO, data=np.bytes_(record.info_text().encode()), track_times=False)
        for name in ("frame_id", "unit"):
            group.attrs[name] = record.info[name]

    def read(self, key: str) -> Record:
        """Read one group."""
        import h5py

        with _damage_named(self.path):
            file = self._open("r")
            if not isinstance(file.get(key, getlink=True, default=None), h5py.HardLink):
                raise CacheError(f"has no group {key!r}")
            group = file[key]
            arrays = {name: _checked_dataset(group, name) for name in group}
            return Record(arrays, parse_info(bytes(arrays.pop(INFO))))

    def close(self) -> None:
        """Close the handle of this process."""
        if self._file is not None and self._opened_by == os.getpid():
            self._file.close()
        self._file = None

    def _open(self, mode: str) -> Any:
        import h5py

        if self._file is None or self._opened_by != os.getpid():
            # A handle that came through fork shares its file position with the parent: never use or close it here.
            _INHERITED.append(self._file)
            self._file = h5py.File(self.path, mode)
            self._opened_by = os.getpid()
        return self._file

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_file": None, "_opened_by": 0}


STORES: dict[Format, type[Store]] = {"hdf5": Hdf5Store, "npz": NpzStore, "pt": PtStore}

COMPRESSIONS: dict[Format, tuple[Compression, ...]] = {
    "hdf5": ("none", "lzf", "gzip"),
    "npz": ("none", "gzip"),
    "pt": ("none",),
}

_INHERITED: list[Any] = []


def _file_of(store: Store, key: str) -> Path:
    return store.folder / "clouds" / f"{key}{store.suffix}"


@contextmanager
def _synced(path: Path) -> Iterator[Any]:
    """Open a new file for writing and force it to disk."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "xb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    """Turn whatever a damaged file makes a library raise into one error that names the file."""
    try:
        yield
    except FileNotFoundError as error:
        raise CacheError(f"{path}: the file is missing; rebuild the dataset") from error
    except CacheError as error:
        raise CacheError(f"{path}: {error}; the file is damaged or not pcdata's: rebuild the dataset") from error
    except MemoryError:
        raise
    except Exception as error:  # zipfile, numpy, h5py and torch raise many types on damaged bytes
        raise CacheError(
            f"{path}: cannot be read ({type(error).__name__}: {error}); the file is damaged or truncated: "
            "rebuild the dataset"
        ) from error


def _check_npz_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> None:
    """Compare the array size that a member's header claims with the bytes it has."""
    if member.file_size > _MAX_RATIO * member.compress_size + 4096:
        raise CacheError(f"member {member.filename!r} claims {member.file_size} bytes from {member.compress_size}")
    with archive.open(member) as stream:
        version = np.lib.format.read_magic(stream)
        readers: dict[tuple[int, int], Callable[..., Any]] = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }
        if version not in readers:
            raise CacheError(f"member {member.filename!r} has npy version {version}")
        shape, _, dtype = readers[version](stream)
        expected = int(np.prod(shape, dtype=object)) * dtype.itemsize
        if dtype.hasobject or expected + stream.tell() != member.file_size:
            raise CacheError(f"member {member.filename!r} claims shape {shape} of {dtype} in {member.file_size} bytes")


def _checked_dataset(group: Any, name: str) -> np.ndarray:
    """Read a dataset that is stored inside this very file and is no larger than its bytes allow."""
    import h5py

    dataset = group[name] if isinstance(group.get(name, getlink=True), h5py.HardLink) else None
    if not isinstance(dataset, h5py.Dataset) or dataset.external or dataset.is_virtual:
        raise CacheError(f"{group.name}/{name} must be a dataset stored in this file, not a link to another")
    claimed = int(np.prod(dataset.shape, dtype=object)) * dataset.dtype.itemsize
    stored = dataset.id.get_storage_size()
    if claimed > (stored if dataset.compression is None else _MAX_RATIO * stored):
        raise CacheError(f"{group.name}/{name} claims shape {dataset.shape} of {dataset.dtype} but stores {stored} bytes")
    array: np.ndarray = dataset[()]
    return array
