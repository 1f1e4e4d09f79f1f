"""The shards of a dataset: each a folder with a store of its own and a table of its files, read as one.

``shards/00012`` holds what a store of that folder wrote, and ``files.tsv``: of every file of the shard, one a line, its
SHA-256, its bytes and its name, those at the top first. The dataset's index has the SHA-256 of each table, so that
every byte of a dataset is known by ``dataset.json``.
"""

from __future__ import annotations

import hashlib
import os
import re
import stat
from collections.abc import Collection, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CacheError, locate, write_fault
from pcdata.files.opening import MAX_STREAMED_BYTES, check_inside, open_input, read_bytes
from pcdata.io.store.cloud_record import Record, Room
from pcdata.io.store.sample_index import SampleIndex
from pcdata.io.store.sample_keys import key_of, keys_of
from pcdata.io.store.store import BatchReader
from pcdata.io.store.stores import STORES, Store

FOLDER, TABLE = "shards", "files.tsv"
SIGNALS_FOLDER = "signals"  # beside the shards: a store with one record, of the signals of all samples
SIGNALS_KEY = "~signals"  # of that record; no sample has a key that begins so

_NAME = re.compile(r"[0-9]{5,}")
_LINE = re.compile(r"([0-9a-f]{64})\t([0-9]{1,18})\t([^\x00-\x1f\x7f\\:]+)")
_MOST_BYTES = 1 << 32  # of a table
_BLOCK = 1 << 22  # bytes that are hashed at once
_MOST_OPEN = 128  # stores that hold a file open
_FEWEST, _MOST_SHARDS = 32, 1000


class StoredFile(NamedTuple):
    """What a shard's table says of a file."""

    sha256: str
    size: int


def shard_size_of(num_samples: int, asked: int | None = None) -> int:
    """Return how many samples of a plan each shard has: what was asked for, or such that there are 1,000 shards."""
    return asked or max(_FEWEST, -(-num_samples // _MOST_SHARDS))


def shard_folder(folder: Path, shard: int) -> Path:
    """Return the folder of one shard of a dataset."""
    return folder / FOLDER / f"{shard:05d}"


def seal_shard(folder: Path) -> str:
    """Write the table of the files of a shard whose store is closed, and force it to disk; return its SHA-256.

    Raises:
        CacheError: it has one already, holds what is no file, or it cannot be written.
    """
    lines = []
    try:
        for name in _names_below(folder):
            size, sha256 = hash_of(folder / name)
            line = f"{sha256}\t{size}\t{name}"
            if _LINE.fullmatch(line) is None:
                raise CacheError(f"{folder / name}: has a name that no table can hold; store it under another")
            lines.append(line + "\n")
        content = "".join(lines).encode("utf-8", "surrogateescape")
        folder.mkdir(parents=True, exist_ok=True)  # of a shard without a sample
        with open(folder / TABLE, "xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise CacheError(f"{folder / TABLE}: cannot be written: {write_fault(error)}") from error
    return hashlib.sha256(content).hexdigest()


def hashes_below(folder: Path) -> dict[str, dict[str, Any]]:
    """Return the bytes and the SHA-256 of every file below a folder, if there is one.

    Raises:
        CacheError: it holds what is no file, or that cannot be read.
    """
    hashes = {name: hash_of(folder / name) for name in _names_below(folder)}
    return {name: {"bytes": size, "sha256": sha256} for name, (size, sha256) in hashes.items()}


def read_tables(folder: Path) -> list[bytes]:
    """Return the SHA-256 of the table of every shard in a dataset's folder, in their order.

    Raises:
        CacheError: there is none, one is missing, or one was not sealed.
    """
    with suppress(FileNotFoundError):
        numbers = sorted(int(name) for name in os.listdir(folder / FOLDER) if _NAME.fullmatch(name))
        if numbers and numbers == [*range(len(numbers))]:
            return [hashlib.sha256(_table_bytes(folder, shard)).digest() for shard in numbers]
    raise CacheError(f"{folder / FOLDER}: must hold the folders 00000, 00001, ... of the dataset's shards")


def read_table(folder: Path, shard: int, sha256: bytes) -> dict[str, StoredFile]:
    """Return the files of one shard by name, as they were written.

    Raises:
        CacheError: the table is missing, or another than the index says.
    """
    content, path = _table_bytes(folder, shard), shard_folder(folder, shard) / TABLE
    if hashlib.sha256(content).digest() != sha256:
        raise _located(path, "is not what was written; copy the shard again, or rebuild the dataset")
    files = {}
    for line in content.decode("utf-8", "surrogateescape").split("\n")[:-1]:
        found = _LINE.fullmatch(line)
        if found is None or found[3] in files or _climbs(found[3]):
            raise _located(path, f"has a line that tells of no file of the shard: {line!r:.200}")
        files[found[3]] = StoredFile(found[1], int(found[2]))
    return files


def hash_of(path: Path) -> tuple[int, str]:
    """Return the size and the SHA-256 of a file.

    Raises:
        CacheError: it is no regular file, or cannot be read.
    """
    total, size = hashlib.sha256(), 0
    if path.stat().st_size == 0:  # which no input may be
        return 0, total.hexdigest()
    with open_input("dataset", path, max_bytes=MAX_STREAMED_BYTES, error=CacheError) as file:
        while block := file.read(_BLOCK):
            total.update(block)
            size += len(block)
    return size, total.hexdigest()


class Shards:
    """The records of a dataset by the number of their sample, wherever they lie.

    A shard is opened when a process first reads one of its records: then its table, its folder and the size of what
    lies at its top are held to what was written.
    """

    def __init__(self, folder: Path, form: str, index: SampleIndex) -> None:
        self.folder = folder
        self._form = form
        self._index = index
        self._stores: dict[int, Store] = {}
        self.closed = 0  # how many stores were closed: what was known of their files may not hold any more
        self._reader: BatchReader | None = None
        self._places: NDArray[np.int64] | None = None  # of all samples, from 1, for the reader; 0 = not known

    def path_of(self, number: int) -> Path:
        """Return the file that holds the record of a sample."""
        shard = int(self._index.shards[number])
        return STORES[self._form](shard_folder(self.folder, shard)).path_of(key_of(self._index.ids[number]))

    def place_of(self, number: int) -> str:
        """Return what messages call the file that holds the record of a sample: its path, or its URL."""
        return str(self.path_of(number))

    def read(self, number: int) -> Record:
        """Read the record of a sample.

        Raises:
            CacheError: missing, damaged or hostile; says which file.
        """
        return self.store(int(self._index.shards[number])).read(key_of(self._index.ids[number]))

    def digest(self, number: int) -> str:
        """Return the digest of a record as it is stored.

        Raises:
            CacheError: as for :meth:`read`.
        """
        return self.store(int(self._index.shards[number])).digest(key_of(self._index.ids[number]))

    def read_joined(
        self, numbers: NDArray[np.int64], room: Room | None = None, *, leave: Collection[str] = ()
    ) -> Record | None:
        """Read the records of some samples as one, in this order; None where the store, or these records, cannot.

        ``room`` gives memory for the arrays, (bytes,) uint8, or None; a store may leave it unasked. Arrays
        to ``leave`` it may leave where they lie: see :class:`Record`.

        Raises:
            CacheError: as for :meth:`read`.
        """
        if self._reader is None or self._places is None:
            self._reader = STORES[self._form].batch_reader()
            if self._reader is None:
                return None
            self._places = np.zeros(len(self._index), np.int64)
        places = self._places[numbers]
        if not places.all():
            for shard in {*self._index.shards[numbers[places == 0]].tolist()}:
                own = self._index.of_shard(shard)
                found = self._reader.places(self.store(shard), keys_of(self._index.ids.part(own)))
                self._places[own.start : own.stop] = found + 1
            places = self._places[numbers]
        return self._reader.read(places - 1, room, leave=leave) if places.all() else None

    def identities(self, numbers: NDArray[np.int64]) -> dict[int, tuple[int, ...]] | None:
        """Return what tells the files of the shards of some samples from others of their names, by shard.

        None where files are opened again for every record: see :meth:`pcdata.io.Store.identity`.

        Raises:
            CacheError: as for :meth:`read`.
        """
        found = {}
        for shard in {*self._index.shards[numbers].tolist()}:
            identity = self.store(shard).identity()
            if identity is None:
                return None
            found[shard] = identity
        return found

    def store(self, shard: int) -> Store:
        """Return the store of one shard.

        Raises:
            CacheError: the shard is missing, lies elsewhere, or a file of it has another size than was written.
        """
        store = self._stores.get(shard)
        if store is None:
            store = self._stores[shard] = self._opened(shard)
        return store

    reads_ahead = False  # whether :meth:`hold` does anything

    def hold(self, numbers: Sequence[int], until: int | None = None) -> None:
        """Read the records of some samples ahead, as often as each is let go; see :meth:`pcdata.io.Store.hold`."""

    def let_go(self, numbers: Sequence[int]) -> None:
        """Forget records that were held."""

    def held(self, numbers: NDArray[np.int64]) -> AbstractContextManager[None]:
        """Hold some records while they are asked for several times."""
        return self._holding(numbers) if self.reads_ahead else nullcontext()

    @contextmanager
    def _holding(self, numbers: NDArray[np.int64]) -> Iterator[None]:
        own = numbers.tolist()
        self.hold(own)
        try:
            yield
        finally:
            self.let_go(own)

    def signals(self) -> Record:
        """Read the record of the signals of all samples.

        Raises:
            CacheError: as for :meth:`read`.
        """
        store = self.signals_store()
        try:
            return store.read(SIGNALS_KEY)
        finally:
            store.close()

    def signals_store(self) -> Store:
        """Return the store that holds the signals of all samples."""
        folder = self.folder / SIGNALS_FOLDER
        _check_place(self.folder, folder)
        return STORES[self._form](folder)

    def close(self) -> None:
        """Close what this process has open."""
        stores, self._stores = self._stores, {}
        self.closed += len(stores)
        self._reader = self._places = None
        for store in stores.values():
            store.close()

    def _opened(self, shard: int) -> Store:
        store = STORES[self._form](shard_folder(self.folder, shard))
        if store.holds_file and len(self._stores) >= _MOST_OPEN:
            self._close(next(iter(self._stores)))
        self._check_sizes(shard)
        return store

    def _close(self, shard: int) -> None:
        """Close the store of a shard; another one is opened when it is asked for again."""
        self._stores.pop(shard).close()
        self.closed += 1
        if self._places is not None:
            own = self._index.of_shard(shard)
            self._places[own.start : own.stop] = 0

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_reader": None, "_places": None}  # addresses of this process

    def _check_sizes(self, shard: int) -> None:
        folder = shard_folder(self.folder, shard)
        for name, told in read_table(self.folder, shard, self._index.tables[shard].tobytes()).items():
            if "/" in name:  # those at the top come first
                break
            with suppress(OSError):  # told when it is opened
                found = os.stat(folder / name)
                if stat.S_ISREG(found.st_mode) and found.st_size != told.size:
                    raise _located(
                        folder / name,
                        f"has {found.st_size} bytes, but {told.size} were written: cut short, or changed; copy it "
                        "again, or rebuild the dataset",
                    )


def _table_bytes(folder: Path, shard: int) -> bytes:
    path = shard_folder(folder, shard) / TABLE
    _check_place(folder, path.parent)
    if not os.path.lexists(path):
        raise _located(path, "the file is missing; rebuild the dataset, or copy it again")
    if path.is_file() and path.stat().st_size == 0:  # of a shard without a sample
        return b""
    return read_bytes("dataset", path, max_bytes=_MOST_BYTES, inside=[folder], error=CacheError)


def _check_place(dataset: Path, folder: Path) -> None:
    try:
        check_inside("dataset", folder, [dataset], CacheError)
    except CacheError as error:
        raise _located(folder, "is a link out of the dataset's folder; put the folder itself there") from error


def _names_below(folder: Path) -> Iterator[str]:
    """Give the names of all files below a folder, those at its top first, in one order on every machine."""

    def refuse(error: OSError) -> None:
        raise error

    found = []
    for place, folders, files in os.walk(folder, onerror=refuse) if folder.is_dir() else ():
        for name in [*files, *folders]:
            path = os.path.join(place, name)
            if os.path.islink(path):
                raise CacheError(f"{path}: is a link, which no shard holds")
        found += [Path(place, name).relative_to(folder).as_posix() for name in files]
    yield from sorted(found, key=lambda name: ("/" in name, name))


def _climbs(name: str) -> bool:
    return name.startswith("/") or any(part in ("", ".", "..") for part in name.split("/"))


def _located(path: Path, what: str) -> CacheError:
    error = CacheError(f"{path}: {what}")
    locate(error, path=path)
    return error
