"""Where records live: one HDF5 file with a group per sample, or a folder of .npz or .pt files.

Readers hold a path, not a handle: files are opened on first use in each process, so a dataset may be pickled, forked or
spawned at any time. Nothing is ever unpickled, and sizes that a file claims are checked against what it holds.
"""

from __future__ import annotations

import errno
import io
import os
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, Literal

import numpy as np
import torch

from pcdata.errors import CacheError, locate, write_fault
from pcdata.files.interrupts import shielded
from pcdata.files.npz import array_names, read_array, write_npz
from pcdata.files.opening import MAX_STREAMED_BYTES, check_inside, open_input
from pcdata.files.packing import check_packing
from pcdata.files.zip_archive import ZipArchive
from pcdata.io.arrays.hdf5_arrays import hard_linked, open_hdf5, read_group
from pcdata.io.arrays.hdf5_writing import FaultKeepingFile
from pcdata.io.arrays.pt_tensors import read_pt
from pcdata.io.store.cloud_record import Record, parse_info

Format = Literal["hdf5", "npz", "pt"]
Compression = Literal["none", "lzf", "gzip"]

INFO = "pcdata"  # the name that the JSON text is stored under


class Store:
    """Records by key inside one dataset folder."""

    suffix: ClassVar[str]

    def __init__(self, folder: str | Path, compression: Compression = "none") -> None:
        self.folder = Path(folder)
        self.compression = compression

    def path_of(self, key: str) -> Path:
        """Return the file that holds a record."""
        return self.folder / "clouds" / f"{key}{self.suffix}"

    def write(self, key: str, record: Record) -> None:
        """Add one record; keys are file-name safe and unique.

        Raises:
            CacheError: the file cannot be written.
        """
        raise NotImplementedError

    def read(self, key: str) -> Record:
        """Read one record.

        Raises:
            CacheError: missing, damaged or hostile; says which file.
        """
        raise NotImplementedError

    def close(self) -> None:
        """Flush to disk and close any handle of this process."""

    @contextmanager
    def _archive(self, path: Path) -> Iterator[ZipArchive]:
        with self._opened(path) as file:
            yield ZipArchive(file, os.fstat(file.fileno()).st_size)

    def _opened(self, path: Path) -> BinaryIO:
        """Open a file of the dataset; links may lead to other files of it."""
        if not os.path.lexists(path):
            raise CacheError(f"{path}: the file is missing; rebuild the dataset, or copy it again")
        # Links are followed only where there is one: that takes longer than opening does.
        if path.is_symlink() or path.parent.is_symlink():
            try:
                check_inside("dataset", path, [self.folder], CacheError)
            except CacheError as error:
                raise CacheError(f"{path}: is a link out of the dataset's folder; put the file itself there") from error
        try:
            return open_input("dataset", path, max_bytes=MAX_STREAMED_BYTES, error=CacheError)
        except CacheError as error:
            if isinstance(error.__cause__, PermissionError):
                raise CacheError(f"{error}; the file itself may be fine") from error
            raise CacheError(f"{error}; rebuild the dataset, or copy it again") from error


class NpzStore(Store):
    """``clouds/<key>.npz``, readable with ``numpy.load``."""

    suffix = ".npz"

    def write(self, key: str, record: Record) -> None:
        """Write one file."""
        with _synced(self.path_of(key)) as file:
            arrays = {**record.arrays, INFO: np.array(record.info_text())}
            write_npz(file, arrays, compressed=self.compression != "none")

    def read(self, key: str) -> Record:
        """Read one file."""
        path = self.path_of(key)
        with _damage_named(path), self._archive(path) as archive:
            members = array_names(archive)
            check_packing("it", sum(member.size for member in members.values()), archive.size)
            arrays = {name: read_array(archive, member) for name, member in members.items()}
            if INFO not in arrays:
                raise CacheError(f"has no member {INFO!r}")
            return Record(arrays, parse_info(str(arrays.pop(INFO))))


class PtStore(Store):
    """``clouds/<key>.pt``: a dict of tensors and one JSON text, loads with ``weights_only=True``."""

    suffix = ".pt"

    def write(self, key: str, record: Record) -> None:
        """Write one file."""
        # A tensor that is a view would drag its whole storage into the file: copy, rows next to each other.
        tensors: dict[str, Any] = {
            name: torch.from_numpy(np.array(array, order="C")) for name, array in record.arrays.items()
        }
        # Through memory: torch's own writer says nothing of the cause where it meets a full disk.
        packed = io.BytesIO()
        torch.save({**tensors, INFO: record.info_text()}, packed)
        with _synced(self.path_of(key)) as file:
            file.write(packed.getbuffer())

    def read(self, key: str) -> Record:
        """Read one file."""
        path = self.path_of(key)
        with _damage_named(path), self._archive(path) as archive:
            stored = read_pt(archive)
            text = stored.pop(INFO, None)
            arrays = {name: value for name, value in stored.items() if not isinstance(value, str)}
            if not isinstance(text, str) or len(arrays) != len(stored):
                raise CacheError(f"must hold a dict with tensors and one text, {INFO!r}")
            return Record(arrays, parse_info(text))


class Hdf5Store(Store):
    """``clouds.h5``: a group per sample with its arrays and the JSON text as datasets."""

    suffix = ".h5"

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
        with _writing(self.path), shielded():
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

        with _damage_named(self.path):
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
        with _writing(self.path), shielded():
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


STORES: dict[Format, type[Store]] = {"hdf5": Hdf5Store, "npz": NpzStore, "pt": PtStore}

COMPRESSIONS: dict[Format, tuple[Compression, ...]] = {
    "hdf5": ("none", "lzf", "gzip"),
    "npz": ("none", "gzip"),
    "pt": ("none",),
}

_TABLES = 1 << 20  # bytes of HDF5's own tables kept in memory while a file is written

_INHERITED: list[Any] = []


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


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Name the file in what a full disk or a missing permission makes a library raise."""
    try:
        yield
    except (OSError, RuntimeError) as error:  # h5py raises both
        failed = CacheError(f"{path}: cannot be written: {write_fault(error)}")
        locate(failed, path=path)
        raise failed from error


@contextmanager
def _synced(path: Path) -> Iterator[Any]:
    """Open a new file for writing and force it to disk."""
    with _writing(path):
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
    except Exception as error:  # numpy and h5py raise many types on damaged bytes
        told = _damage(path, error)
        locate(told, path=path)
        if told is error:
            raise
        raise told from error


def _damage(path: Path, error: Exception) -> CacheError:
    if isinstance(error, CacheError):
        if str(path) in str(error):  # complete in itself: the file may be fine
            return error
        return CacheError(f"{path}: {error}; the file is damaged or not pcdata's: rebuild the dataset")
    if isinstance(error, MemoryError):
        return CacheError(f"{path}: there is not enough memory to read it ({error}); the file may be fine")
    if isinstance(error, OSError) and error.errno in (errno.EACCES, errno.EPERM, errno.EMFILE, errno.ENFILE):
        return CacheError(f"{path}: cannot be opened: {error}; the file itself may be fine")
    kind = type(error).__name__
    return CacheError(
        f"{path}: cannot be read ({kind}: {error}); the file is damaged or truncated: rebuild the dataset"
    )
