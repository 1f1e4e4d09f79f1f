"""Where the records of a dataset live: what every store does, and the registry of them.

Readers hold a path, not a handle: files are opened on first use in each process, so a dataset may be pickled, forked or
spawned at any time. Nothing is ever unpickled, and sizes that a file claims are checked against what it holds.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CacheError, ConfigError, locate, write_fault
from pcdata.files.library_errors import told_by_library
from pcdata.files.opening import MAX_STREAMED_BYTES, check_inside, open_input
from pcdata.files.urls import UrlFolder
from pcdata.files.zip_archive import ZipArchive
from pcdata.io.store.cloud_record import Record, Room
from pcdata.io.store.text_table import TextTable
from pcdata.registry import Registry

Compression = Literal["none", "lzf", "gzip"]

INFO = "pcdata"  # the name that the JSON text is stored under


class BatchReader(Protocol):
    """What a process knows of some stores of one class, and reads records of several of them as one with."""

    def places(self, store: Any, keys: TextTable) -> NDArray[np.int64]:
        """Return where records of a store lie, by their keys: a number each, -1 where it has none of the key.

        Raises:
            CacheError: as for :meth:`Store.read`.
        """
        ...

    def read(
        self, places: NDArray[np.int64], room: Room | None = None, *, leave: Collection[str] = ()
    ) -> Record | None:
        """Return the record of all clouds of some places in a row; None where these records can have none.

        ``room`` gives memory for the arrays; a reader may leave it unasked. Arrays to ``leave`` it may leave where
        they lie, and say where: see :class:`Record`.

        Raises:
            CacheError: as for :meth:`Store.read`.
        """
        ...


class Store:
    """Records by key inside one folder, a shard of a dataset.

    Subclass it and :func:`register_store` for a format of your own.
    """

    format: ClassVar[str]  # its name in ``output: {format: ...}``
    compressions: ClassVar[tuple[Compression, ...]]  # that it knows, "none" among them
    suffix: ClassVar[str]  # of its files
    holds_file: ClassVar[bool] = False  # whether one that was read keeps a file open until it is closed

    def __init__(self, folder: str | Path, compression: Compression = "none") -> None:
        self.folder = Path(folder)
        self.compression = compression

    @classmethod
    def at_url(cls, server: UrlFolder, name: str) -> Store:
        """Return the store that reads a shard below a URL.

        Raises:
            CacheError: such a store reads files alone.
        """
        raise CacheError(
            f"{server}: format {cls.format} is read from folders alone: copy the dataset to one, or build it with "
            "output: {format: webdataset}"
        )

    def path_of(self, key: str) -> Path:
        """Return the file that holds a record."""
        return self.folder / "clouds" / f"{key}{self.suffix}"

    def place_of(self, key: str) -> str:
        """Return what messages call the file that holds a record: its path, or its URL."""
        return str(self.path_of(key))

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

    def digest(self, key: str) -> str:
        """Return the digest of a record as it is stored.

        Raises:
            CacheError: as for :meth:`read`.
        """
        return self.read(key).digest()

    @classmethod
    def batch_reader(cls) -> BatchReader | None:
        """Return what reads records of stores of this class as one; None where nothing does.

        The digests of the records are compared before: see :meth:`identity`.
        """
        return None

    def hold(self, keys: Sequence[str], until: str | None = None) -> None:
        """Read some records ahead, where that saves anything, as often as :meth:`let_go` forgets each.

        All up to ``until`` will be asked for soon.

        Raises:
            CacheError: as for :meth:`read`.
        """

    def let_go(self, keys: Sequence[str]) -> None:
        """Forget records that were held."""

    def identity(self) -> tuple[int, ...] | None:
        """Return what tells the file that this process reads, and keeps, from others of its name.

        So long as it is the same, a record whose digest was right once is not compared again. None = files are opened
        again for every record, which is compared each time.
        """
        return None

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


STORES: Registry[type[Store]] = Registry("store")


def register_store(store: type[Store]) -> type[Store]:
    """Make a store known by its ``format``, to builds, to datasets and to ``--format``; a decorator.

    Raises:
        ConfigError: it is no :class:`Store`, does not say its format and compressions, cannot read or write, or its
            name is taken.
    """
    where = "register_store"
    if not (isinstance(store, type) and issubclass(store, Store)):
        raise ConfigError(f"{where}: must be a subclass of pcdata.io.Store, got {store!r:.100}")
    for name in ("format", "suffix"):
        if not isinstance(getattr(store, name, None), str):
            raise ConfigError(f"{where}: {store.__name__}.{name} must be a text; see pcdata.io.Store")
    if "none" not in getattr(store, "compressions", ()):
        raise ConfigError(f'{where}: {store.__name__}.compressions must be a tuple with "none" in it')
    for method in ("read", "write"):
        if getattr(store, method) is getattr(Store, method):
            raise ConfigError(f"{where}: {store.__name__} has no method {method}; write it")
    STORES.add(store.format, store)
    return store


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Name the file in what a full disk or a missing permission makes a library raise."""
    try:
        yield
    except (OSError, RuntimeError) as error:  # h5py raises both
        failed = CacheError(f"{path}: cannot be written: {write_fault(error)}")
        locate(failed, path=path)
        raise failed from error


@contextmanager
def synced(path: Path) -> Iterator[Any]:
    """Open a new file for writing and force it to disk."""
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())


@contextmanager
def damage_named(path: Path | str) -> Iterator[None]:
    """Turn whatever a damaged file makes a library raise into one error that names the file."""
    try:
        yield
    except Exception as error:  # numpy and h5py raise many types on damaged bytes
        told = _damage(path, error)
        locate(told, path=path)
        if told is error:
            raise
        raise told from error


def _damage(path: Path | str, error: Exception) -> CacheError:
    if isinstance(error, CacheError):
        if str(path) in str(error):  # complete in itself: the file may be fine
            return error
        return CacheError(f"{path}: {error}; the file is damaged or not pcdata's: rebuild the dataset")
    if isinstance(error, MemoryError):
        return CacheError(f"{path}: there is not enough memory to read it ({error}); the file may be fine")
    if isinstance(error, OSError) and error.errno in (errno.EACCES, errno.EPERM, errno.EMFILE, errno.ENFILE):
        return CacheError(f"{path}: cannot be opened: {error}; the file itself may be fine")
    return CacheError(
        f"{path}: cannot be read: {told_by_library(error)}; the file is damaged or truncated: rebuild the dataset"
    )
