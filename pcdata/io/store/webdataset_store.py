"""Datasets for streaming: a tar archive a shard, with a group of members for every sample, as WebDataset reads them."""

from __future__ import annotations

import functools
import json
import operator
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote, unquote

import numpy as np
import torch
from numpy.typing import NDArray

from pcdata.errors import CacheError
from pcdata.files.mapping import identity_of, map_file
from pcdata.files.npy import PREFIX, NpyHeader, header_length, npy_bytes, parse_header
from pcdata.files.tar_members import read_members
from pcdata.files.urls import UrlFolder
from pcdata.io.store.cloud_record import DERIVED, Record, Room, parse_info
from pcdata.io.store.joined_record import common_and_own, joined_record, own_info
from pcdata.io.store.store import Compression, Store, damage_named, register_store, writing
from pcdata.io.store.tar_shard import TarShard, TarWriter
from pcdata.io.store.text_table import TextTable
from pcdata.structures.read_later import StoredTexts

_FILE = "clouds.tar"
_USUAL = 128  # bytes of the header of a .npy array
_ALIGNED = 64  # bytes: a line of the processor's cache
_ARRAY, _INFO, _HISTORY = ".npy", "json", "history.json"


@register_store
class _WebDatasetStore(Store):
    """``clouds.tar``: of every sample ``KEY.NAME.npy`` for each array, ``KEY.json`` and ``KEY.history.json``.

    In KEY dots are ``%2E``, since WebDataset takes the first one for the end of the key. See
    :mod:`pcdata.io.store.tar_shard` for how samples are found. Like a packed file it is written once and mapped.
    """

    format = "webdataset"
    compressions = ("none",)
    suffix = ".tar"

    def __init__(self, folder: str | Path, compression: Compression = "none") -> None:
        super().__init__(folder, compression)
        self.path = self.folder / _FILE
        self._place = str(self.path)
        self._server: tuple[UrlFolder, str] | None = None  # and the name of the archive there
        self._writer: TarWriter | None = None
        self._shard: TarShard | None = None

    @classmethod
    def at_url(cls, server: UrlFolder, name: str) -> _WebDatasetStore:
        """Return the store that reads an archive below a URL."""
        store = cls(name)
        store._server = server, f"{name}/{_FILE}"
        store._place = f"{server}/{name}/{_FILE}"
        return store

    def path_of(self, key: str) -> Path:
        """Return the one file that holds all records."""
        return self.path

    def place_of(self, key: str) -> str:
        """Return its path, or its URL."""
        return self._place

    def write(self, key: str, record: Record) -> None:
        """Add one record; the file is whole after :meth:`close`."""
        members = sorted(_members(_member_key(key), record), key=operator.itemgetter(0))
        with writing(self.path):
            writer, self._writer = self._writer or TarWriter(self.path), None
            writer.add(key, members)
            self._writer = writer  # one that failed is not gone on with

    def close(self) -> None:
        """Force what was written to disk, or forget the mapped file of this process."""
        writer, self._writer, self._shard = self._writer, None, None
        if writer is not None:
            with writing(self.path):
                writer.finish()

    def read(self, key: str) -> Record:
        """Read one record; its arrays are the caller's own."""
        with damage_named(self._place):
            own = memoryview(bytearray(self.opened().sample(key)))
            return _Parts.of(key, own).record()

    def digest(self, key: str) -> str:
        """Return the digest of one record, computed where it lies."""
        with damage_named(self._place):
            return _Parts.of(key, self.opened().sample(key)).record().digest()

    @classmethod
    def batch_reader(cls) -> _Reader:
        """Return what reads records of one archive, or of several, as one; every array is copied once."""
        return _Reader()

    def hold(self, keys: Sequence[str], until: str | None = None) -> None:
        """Read some records ahead, from a server with few requests."""
        with damage_named(self._place):
            self.opened().hold(keys, until)

    def let_go(self, keys: Sequence[str]) -> None:
        """Forget records that were held."""
        self.opened().let_go(keys)

    def identity(self) -> tuple[int, ...] | None:
        """Return what tells the archive from another of its name."""
        with damage_named(self._place):
            return self.opened().identity

    def opened(self) -> TarShard:
        """Return the archive, opened once in every process."""
        if self._writer is not None:
            raise CacheError(f"{self._place}: is being written; close the store, then read")
        if self._shard is None:
            self._shard = self._open()
        return self._shard

    def _open(self) -> TarShard:
        if self._server is not None:
            server, name = self._server
            status = server.status(name)
            return TarShard(
                status.size, lambda begin, end: server.read(name, begin, end), status.identity, is_mapped=False
            )
        with self._opened(self.path) as file:
            content = map_file(file)
            return TarShard(len(content), lambda begin, end: content[begin:end], identity_of(file))

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_writer": None, "_shard": None}


class _Parts(NamedTuple):
    """A record as it lies in its archive."""

    arrays: dict[str, NDArray[Any]]
    info: bytes  # JSON, without the history
    history: bytes  # JSON; b"" = it stands in the info, or there is none

    @classmethod
    def of(cls, key: str, members: memoryview) -> _Parts:
        """Take the members of a sample apart; nothing is copied."""
        prefix, last = _member_key(key) + ".", ""
        arrays: dict[str, NDArray[Any]] = {}
        info: bytes | None = None
        history = b""
        for name, content in read_members(members):
            if not name.startswith(prefix) or name <= last:
                raise CacheError(f"member {name!r:.300} is in the place of one of {key!r:.300}, or comes twice")
            last, field = name, name[len(prefix) :]
            if field == _INFO:
                info = bytes(content)
            elif field == _HISTORY:
                history = bytes(content)
            elif not field.endswith(_ARRAY) or (own := unquote(field.removesuffix(_ARRAY))) in arrays:
                raise CacheError(f"member {name!r:.300} is no array of a record, or one that it has already")
            else:
                arrays[own] = _array(name, content)
        if info is None:
            raise CacheError(f"{key!r:.300} has no member {prefix + _INFO!r:.300}")
        return cls(arrays, info, history)

    def record(self) -> Record:
        """Return it with its history."""
        if self.history and "history" in parse_info(self.info):
            raise CacheError("two members have its history")
        return Record(self.arrays, own_info(self.info, self.history))


def _member_key(key: str) -> str:
    return quote(key.replace(".", "%2E"), safe="%~")


def _members(key: str, record: Record) -> Iterator[tuple[str, Any]]:
    text, history = _facts(record)
    yield f"{key}.{_INFO}", text.encode()
    if history:
        yield f"{key}.{_HISTORY}", history.encode()
    taken = set[str]()
    for name, array in record.arrays.items():
        quoted = quote(name, safe="")
        if quoted.casefold() in taken:  # WebDataset takes names for one that differ by case alone
            quoted = "".join(f"%{byte:02X}" for byte in name.encode())
        taken.add(quoted.casefold())
        yield f"{key}.{quoted}{_ARRAY}", npy_bytes(np.ascontiguousarray(array).reshape(array.shape))


def _facts(record: Record) -> tuple[str, str]:
    """Return the facts of a record as JSON, and its history apart: that is long, and seldom read."""
    text = record.info_text()
    history = record.info.get("history")
    rest = {name: value for name, value in record.info.items() if name != "history"}
    if not isinstance(history, list) or Record({}, {**rest, "history": history}).info_text() != text:
        return text, ""  # not what is usual; told when it is read
    return Record({}, rest).info_text(), Record({}, {"history": history}).info_text()[len('{"history":') : -1]


def _array(name: str, content: memoryview) -> NDArray[Any]:
    try:
        header = _npy_header(bytes(content[:_USUAL]), len(content))
        if header is None:
            header = parse_header(bytes(content[: header_length(bytes(content[:PREFIX]))]), len(content))
    except CacheError as error:
        raise CacheError(f"member {name!r:.300}: {error}") from error
    if not header.nbytes:
        return np.zeros(header.shape, header.dtype)
    order: Any = "F" if header.by_columns else "C"
    return np.ndarray(header.shape, header.dtype, content, header.begin, order=order)


@functools.lru_cache(1024)  # most samples have the same few headers, and parsing one takes longer than all else
def _npy_header(start: bytes, size: int) -> NpyHeader | None:
    """Return what a header of the usual length says; None = it has another."""
    return parse_header(start, size) if header_length(start[:PREFIX]) == _USUAL else None


class _Reader:
    """Reads batches: the place of a record is its number among those that were asked about."""

    def __init__(self) -> None:
        self._records: list[tuple[_WebDatasetStore, str]] = []

    def places(self, store: _WebDatasetStore, keys: TextTable) -> NDArray[np.int64]:
        """Return where records lie; whether they do is told when they are read."""
        first = len(self._records)
        self._records += [(store, key) for key in keys]
        return np.arange(first, len(self._records))

    def read(
        self, places: NDArray[np.int64], room: Room | None = None, *, leave: Collection[str] = ()
    ) -> Record | None:
        """Return the record of all clouds, points and all."""
        parts: list[_Parts] = []
        records = [self._records[place] for place in places.tolist()]
        for store, key in records:
            with damage_named(store.place_of("")):
                parts.append(_Parts.of(key, store.opened().sample(key)))
        with damage_named(records[0][0].place_of("")):
            return _joined(parts, room)


def _joined(parts: Sequence[_Parts], room: Room | None) -> Record | None:
    """Return the record of all clouds in a row; None where they do not share a batch, or one is no cloud."""
    if not all(part.history for part in parts):
        return None
    # The strict parser looked at each when its digest was compared.
    split = [common_and_own(info) for info in json.loads(b"[" + b",".join(part.info for part in parts) + b"]")]
    if any(common != split[0][0] for common, _ in split):
        return None
    joined = _joined_arrays([part.arrays for part in parts], room)
    if joined is None:
        return None
    arrays, rows = joined
    histories = StoredTexts.of([part.history for part in parts])
    return joined_record(arrays, rows, split[0][0], [own for _, own in split], histories)


def _joined_arrays(
    records: Sequence[dict[str, NDArray[Any]]], room: Room | None
) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[np.int64]]] | None:
    """Return each array with its rows one record after another, and how many are of each; None where they differ."""
    forms = [
        {name: (one.dtype, one.shape[1:], one.ndim > 0) for name, one in record.items() if name not in DERIVED}
        for record in records
    ]
    if any(form != forms[0] for form in forms) or not all(has_rows for *_, has_rows in forms[0].values()):
        return None
    begins, total = {}, 0
    for name in forms[0]:
        begins[name] = total
        size = sum(record[name].nbytes for record in records)
        total += size + -size % _ALIGNED
    memory = None if room is None else room(total)
    if memory is None:
        memory = torch.empty(total, dtype=torch.uint8, device="cpu")
    held, arrays, rows = memory.numpy(), {}, {}
    for name, (dtype, row, _) in forms[0].items():
        own = [record[name] for record in records]
        rows[name] = np.array([len(one) for one in own], dtype=np.int64)
        size = sum(one.nbytes for one in own)
        shape = int(rows[name].sum()), *row
        arrays[name] = held[begins[name] : begins[name] + size].view(dtype).reshape(shape)
        np.concatenate(own, out=arrays[name])
    return arrays, rows
