"""Datasets at a URL: the small files are fetched, the samples stay where they are until they are asked for.

``dataset.json``, the index and the tables of the shards come into a folder of this machine, which the process that
opened the dataset deletes at its end, and are held to the same sums as those of a folder. Samples are read as ranges of
bytes: many with one request where they follow each other.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pcdata.errors import CacheError
from pcdata.files.opening import replacing
from pcdata.files.urls import UrlFolder, is_url, path_of
from pcdata.files.whole_folders import DATASET, INDEX
from pcdata.io.store.sample_index import FILES, SampleIndex
from pcdata.io.store.sample_keys import key_of
from pcdata.io.store.shards import FOLDER, SIGNALS_FOLDER, TABLE, Shards, read_table
from pcdata.io.store.stores import STORES, Store

_PIECE = 8 << 20  # bytes of a request
_MOST_BYTES = 1 << 36  # of a file that is fetched
_MOST_OPEN = 64  # shards whose index is kept

_FETCHED: dict[tuple[str, str], Path] = {}  # URL and SHA-256 of dataset.json -> the folder of its small files


def opened_folder(
    where: str, place: str | os.PathLike[str], options: Mapping[str, Any] | None = None
) -> tuple[Path, UrlFolder | None]:
    """Return a dataset's folder; of one at a URL that of its small files, and the URL.

    Raises:
        CacheError: there is no dataset, or it cannot be had.
        ConfigError: nobody knows this kind of URL.
        MissingExtraError: its package is not installed.
    """
    if not isinstance(place, str) or not is_url(place):
        return path_of(place), None
    server = UrlFolder(where, place, error=CacheError, options=options)
    content = server.read(DATASET, 0, server.status(DATASET).size)
    known = server.url, hashlib.sha256(content).hexdigest()
    if known not in _FETCHED or not _FETCHED[known].is_dir():
        folder = Path(tempfile.mkdtemp(prefix="pcdata-"))
        atexit.register(_remove, folder, os.getpid())
        for name in FILES:
            fetch(server, folder, f"{INDEX}/{name}")
        (folder / DATASET).write_bytes(content)
        _FETCHED[known] = folder
    return _FETCHED[known], server


def is_read_at_urls(form: str) -> bool:
    """Say whether datasets of a format are read where they are, at a URL."""
    return getattr(STORES[form].at_url, "__func__", None) is not getattr(Store.at_url, "__func__", None)


def fetch(server: UrlFolder, folder: Path, name: str) -> Path:
    """Copy a small file of a dataset to the same place below a folder, unless it is there; return its path.

    Raises:
        CacheError: it is missing, larger than such a file is, or cannot be had.
    """
    path = folder / name
    if not path.is_file():
        size = server.status(name).size
        if size > _MOST_BYTES:
            raise CacheError(f"{server}/{name}: has {size} bytes, more than the limit of {_MOST_BYTES} for this kind")
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing("dataset", path, error=CacheError) as temporary, open(temporary, "wb") as file:
            for begin in range(0, size, _PIECE):
                file.write(server.read(name, begin, min(begin + _PIECE, size)))
    return path


class UrlShards(Shards):
    """The records of a dataset at a URL; those that are held are not asked for again."""

    def __init__(self, server: UrlFolder, folder: Path, form: str, index: SampleIndex) -> None:
        super().__init__(folder, form, index)
        STORES[form].at_url(server, FOLDER)  # refuses now what could not be read later
        self.server = server
        self._held: dict[int, int] = {}  # shard -> how many of its samples

    def place_of(self, number: int) -> str:
        """Return the URL of the file that holds the record of a sample."""
        shard = int(self._index.shards[number])
        return STORES[self._form].at_url(self.server, _name(shard)).place_of(key_of(self._index.ids[number]))

    reads_ahead = True

    def hold(self, numbers: Sequence[int], until: int | None = None) -> None:
        """Read the records of some samples ahead, and keep them as they lie in their file."""
        last = None if until is None else key_of(self._index.ids[until])
        for shard, own in self._by_shard(numbers).items():
            self.store(shard).hold([key_of(self._index.ids[number]) for number in own], last)
            self._held[shard] = self._held.get(shard, 0) + len(own)

    def let_go(self, numbers: Sequence[int]) -> None:
        """Forget records that were held."""
        for shard, own in self._by_shard(numbers).items():
            self.store(shard).let_go([key_of(self._index.ids[number]) for number in own])
            self._held[shard] = self._held.get(shard, 0) - len(own)

    def signals_store(self) -> Store:
        """Return the store that holds the signals of all samples."""
        return STORES[self._form].at_url(self.server, SIGNALS_FOLDER)

    def _opened(self, shard: int) -> Store:
        store = STORES[self._form].at_url(self.server, _name(shard))
        idle = [other for other in self._stores if not self._held.get(other)]
        if len(self._stores) >= _MOST_OPEN and idle:
            self._close(idle[0])
        fetch(self.server, self.folder, f"{_name(shard)}/{TABLE}")
        for name, told in read_table(self.folder, shard, self._index.tables[shard].tobytes()).items():
            found = self.server.status(f"{_name(shard)}/{name}").size if "/" not in name else told.size
            if found != told.size:
                raise CacheError(
                    f"{self.server}/{_name(shard)}/{name}: has {found} bytes, but {told.size} were written: cut short, "
                    "or changed; copy it again, or rebuild the dataset"
                )
        return store

    def _by_shard(self, numbers: Sequence[int]) -> dict[int, list[int]]:
        found: dict[int, list[int]] = {}
        for number, shard in zip(numbers, self._index.shards[numbers].tolist()):
            found.setdefault(shard, []).append(number)
        return found


def _name(shard: int) -> str:
    return f"{FOLDER}/{shard:05d}"


def _remove(folder: Path, process: int) -> None:
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)
