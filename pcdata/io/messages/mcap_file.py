"""MCAP files: records, chunks of them, and an index at the end; read by the index, or through where it is missing.

Source: https://mcap.dev/spec
"""

from __future__ import annotations

import os
from typing import BinaryIO

import numpy as np

from pcdata.errors import CaptureError
from pcdata.io.messages.byte_fields import Fields
from pcdata.io.messages.chunked_file import IN_FILE, ChunkedFile
from pcdata.io.messages.log_file import LATEST, MAX_MESSAGE, Index, Place, by_topic, type_name
from pcdata.io.messages.packing import unpacked

MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX, _CHUNK_INDEX, _DATA_END = 2, 3, 4, 5, 6, 7, 8, 15
_MOST = 1 << 24  # bytes of a record that is no message and no chunk
_RECORD = 9  # bytes of a record before its content: what it is, and its length
_MESSAGE_START = 22  # bytes of a message before its data
_PACKINGS = {"": "none", "none": "none", "lz4": "lz4", "zstd": "zstd"}
_ENTRY = np.dtype([("time", "<u8"), ("offset", "<u8")])


class McapFile(ChunkedFile):
    """One .mcap file."""

    suffix = ".mcap"
    container = "MCAP file"
    magic = MAGIC
    begins_as = "an MCAP file"

    def _indexed(self, stream: BinaryIO, size: int) -> Index:
        return _Indexer(stream, size).index()

    def _seek_message(self, stream: BinaryIO, start: int, size: int) -> int:
        kind, length = _record(stream, start, size)
        if kind != _MESSAGE or not _MESSAGE_START <= length <= MAX_MESSAGE:
            raise CaptureError(f"{self.path}: no message stands at byte {start}; the file is damaged")
        stream.seek(_MESSAGE_START, os.SEEK_CUR)
        return length - _MESSAGE_START

    def _unpacked_chunk(self, stream: BinaryIO, start: int, size: int) -> bytes:
        return _unpacked_chunk(stream, start, size)

    def _skip_to_message(self, chunk: Fields, start: int) -> int:
        kind, length = chunk.number("B"), chunk.number("Q")
        if kind != _MESSAGE or not _MESSAGE_START <= length <= chunk.left:
            raise CaptureError(f"{self.path}: no message stands in the chunk at byte {start}; it is damaged")
        chunk.take(_MESSAGE_START)
        return length - _MESSAGE_START


def _unpacked_chunk(stream: BinaryIO, start: int, size: int) -> bytes:
    kind, length = _record(stream, start, size)
    if kind != _CHUNK:
        raise CaptureError(f"no chunk stands at byte {start}; the file is damaged")
    content, checksum, packing, packed = _chunk_head(stream, length)
    return unpacked(_exactly(stream, packed), packing, content, checksum)


def _chunk_head(stream: BinaryIO, length: int) -> tuple[int, int, str, int]:
    """Return the unpacked size, the checksum, the packing and the packed size; the stream is at the content then."""
    head = Fields(_exactly(stream, min(length, 28 + 4 + 32 + 8)))
    head.take(16)  # its times
    content, checksum, packing = head.number("Q"), head.number("I"), head.text(32)
    packed = head.number("Q")
    start = 28 + 4 + len(packing.encode()) + 8
    if packing not in _PACKINGS:
        raise CaptureError(f"a chunk is packed with {packing!r}; known are {', '.join(filter(None, _PACKINGS))}")
    if start + packed != length:
        raise CaptureError(f"a chunk of {length} bytes claims {packed} packed ones; the file is damaged")
    stream.seek(start - min(length, 28 + 4 + 32 + 8), os.SEEK_CUR)
    return content, checksum, _PACKINGS[packing], packed


def _record(stream: BinaryIO, start: int, size: int) -> tuple[int, int]:
    """Return what the record at a byte is and its length; the stream is at its content then."""
    if not 0 < start <= size - _RECORD:
        raise CaptureError(f"a record should be at byte {start} of {size}; the file is cut short or damaged")
    stream.seek(start)
    head = Fields(_exactly(stream, _RECORD))
    kind, length = head.number("B"), head.number("Q")
    if length > size - start - _RECORD:
        raise CaptureError(
            f"the record at byte {start} claims {length} bytes where {size - start - _RECORD} follow; the file is cut "
            "short"
        )
    return kind, length


def _exactly(stream: BinaryIO, size: int) -> bytes:
    content = stream.read(size)
    if len(content) != size:
        raise CaptureError(f"it ends {size - len(content)} bytes too early; the file is cut short")
    return content


class _Indexer:
    """Finds the messages of one open file."""

    def __init__(self, stream: BinaryIO, size: int) -> None:
        self._stream, self._size = stream, size
        self._schemas: dict[int, tuple[str, str]] = {}  # name, encoding
        self._channels: dict[int, str] = {}  # the topic's name
        self._index = Index()

    def index(self) -> Index:
        """Return what the file holds."""
        try:
            summary = self._summary_start()
            chunks = self._read_summary(summary) if summary else []
            seen: set[int] = set()
            for chunk in chunks:
                self._add_chunk(chunk, seen)
        except (CaptureError, ValueError) as error:
            self._forget()
            return self._scanned(f"its index cannot be read ({error}), so it was read through")
        if chunks:
            return self._index
        self._forget()
        return self._scanned(None)

    def _forget(self) -> None:
        self._schemas, self._channels, self._index = {}, {}, Index()

    def _summary_start(self) -> int:
        """Return where the summary is; 0 where there is none."""
        if self._size < 2 * len(MAGIC) + _RECORD + 20:
            raise CaptureError("the end of the file is missing")
        self._stream.seek(-(_RECORD + 20 + len(MAGIC)), os.SEEK_END)
        end = Fields(_exactly(self._stream, _RECORD + 20 + len(MAGIC)))
        kind, length, summary = end.number("B"), end.number("Q"), end.number("Q")
        end.take(12)
        if end.take(len(MAGIC)) != MAGIC or (kind, length) != (_FOOTER, 20):
            raise CaptureError("the end of the file is missing")
        if summary and not len(MAGIC) < summary <= self._size:
            raise CaptureError(f"its summary should be at byte {summary} of {self._size}")
        return summary

    def _read_summary(self, place: int) -> list[Fields]:
        chunks: list[Fields] = []
        while True:
            kind, length = _record(self._stream, place, self._size)
            if kind == _FOOTER:
                return chunks
            if kind in (_SCHEMA, _CHANNEL, _CHUNK_INDEX):
                content = Fields(_exactly(self._stream, _at_most(length)))
                if kind == _CHUNK_INDEX:
                    chunks.append(content)
                else:
                    self._declare(kind, content)
            place += _RECORD + length

    def _declare(self, kind: int, content: Fields) -> None:
        number = content.number("H")
        if kind == _SCHEMA:
            self._schemas[number] = (content.text(), content.text())
            return
        schema, topic, encoding = content.number("H"), content.text(), content.text()
        self._channels[number] = topic
        self._index.add_topic(topic, type_name(self._schemas.get(schema, ("", ""))[0]), encoding)

    def _topic(self, channel: int) -> str:
        if channel not in self._channels:
            raise CaptureError(f"it has messages of a channel {channel} that it does not describe; it is damaged")
        return self._channels[channel]

    def _add_chunk(self, described: Fields, seen: set[int]) -> None:
        described.take(16)  # its times
        start, length = described.number("Q"), described.number("Q")
        described.take(described.number("I"))  # where in the index each channel is: it is read as a whole
        indexed, packing = described.number("Q"), described.text()
        if start in seen:
            raise CaptureError("its index names one chunk twice; the file is damaged")
        seen.add(start)
        kind, content = _record(self._stream, start, self._size)
        if kind != _CHUNK or content != length - _RECORD:
            raise CaptureError(f"its index names a chunk at byte {start} that is not there; the file is damaged")
        if not indexed:
            self._scan_chunk(start, content, self._size)
            return
        unpacked_size, _, packing, _ = _chunk_head(self._stream, content)
        begin = self._stream.tell()
        if start + length + indexed > self._size:
            raise CaptureError(f"the index of the chunk at byte {start} leads out of the file; it is cut short")
        self._stream.seek(start + length)
        indexes = Fields(_exactly(self._stream, indexed))
        while indexes.left:
            kind, content = indexes.number("B"), indexes.number("Q")
            entry = Fields(indexes.take(content))
            if kind != _MESSAGE_INDEX:
                raise CaptureError(f"a record of kind {kind} stands in the index of a chunk; the file is damaged")
            topic = self._topic(entry.number("H"))
            rows = np.frombuffer(entry.take(entry.number("I")), _ENTRY)
            if len(rows) and (rows["time"].max() > LATEST or rows["offset"].max() >= unpacked_size):
                raise CaptureError(f"the index of the chunk at byte {start} leads out of it; the file is damaged")
            places = np.empty((len(rows), 2), np.int64)
            plain = packing == "none"
            places[:, 0] = begin + rows["offset"].astype(np.int64) if plain else start
            places[:, 1] = IN_FILE if plain else rows["offset"]
            self._index.add(topic, rows["time"].astype(np.int64), places)

    # -- without an index ----------------------------------------------------------------------------------------------

    def _scanned(self, damage: str | None) -> Index:
        """Read through the file, as far as it can be read."""
        place, found = len(MAGIC), dict[str, list[tuple[int, int, int]]]()
        try:
            while place < self._size:
                if self._size - place < _RECORD:
                    raise CaptureError("it ends within a record")
                self._stream.seek(place)
                head = Fields(_exactly(self._stream, _RECORD))
                kind, length = head.number("B"), head.number("Q")
                if kind in (_DATA_END, _FOOTER):
                    break
                if kind == _CHUNK:
                    self._scan_chunk(place, length, self._size, found)
                _record(self._stream, place, self._size)  # that it is whole
                if kind in (_SCHEMA, _CHANNEL):
                    self._declare(kind, Fields(_exactly(self._stream, _at_most(length))))
                elif kind == _MESSAGE:
                    self._scan_message(Fields(_exactly(self._stream, _MESSAGE_START)), (place, IN_FILE), found)
                elif kind == 0 or (kind > _DATA_END and kind < 0x80):
                    raise CaptureError(f"no record is of the kind {kind}")
                place += _RECORD + length
        except (CaptureError, ValueError) as error:
            count = sum(map(len, found.values()))
            before = "it was read through" if damage is None else damage
            damage = f"{before}, up to byte {place} of {self._size}: {count} messages, then {error}"
        if damage is not None and not found:
            raise CaptureError(f"no message can be read: {damage}")
        by_topic(found, self._index)
        self._index.damage = damage
        return self._index

    def _scan_chunk(
        self, start: int, length: int, end: int, found: dict[str, list[tuple[int, int, int]]] | None = None
    ) -> None:
        """Note the messages of a chunk; of one that is not packed also where its end is missing."""
        messages: dict[str, list[tuple[int, int, int]]] = {} if found is None else found
        self._stream.seek(start + _RECORD)
        _, _, packing, packed = _chunk_head(self._stream, length)
        if packing == "none":
            begin, place = self._stream.tell(), 0
            while place < min(packed, end - begin):
                kind, inner = _record(self._stream, begin + place, end)
                if kind in (_SCHEMA, _CHANNEL):
                    self._declare(kind, Fields(_exactly(self._stream, _at_most(inner))))
                elif kind == _MESSAGE:
                    head = Fields(_exactly(self._stream, _MESSAGE_START))
                    self._scan_message(head, (begin + place, IN_FILE), messages)
                place += _RECORD + inner
        else:
            content = Fields(_unpacked_chunk(self._stream, start, end))
            while content.left:
                place = content.place
                kind = content.number("B")
                inside = Fields(content.take(content.number("Q")))
                if kind in (_SCHEMA, _CHANNEL):
                    self._declare(kind, inside)
                elif kind == _MESSAGE:
                    self._scan_message(inside, (start, place), messages)
        if found is None:
            by_topic(messages, self._index)

    def _scan_message(self, head: Fields, place: Place, found: dict[str, list[tuple[int, int, int]]]) -> None:
        topic = self._topic(head.number("H"))
        head.take(4)
        time = head.number("Q")
        if time > LATEST:
            raise CaptureError(f"a message of {topic!r:.100} is of the time {time}; the file is damaged")
        found.setdefault(topic, []).append((time, *place))


def _at_most(length: int) -> int:
    if length > _MOST:
        raise CaptureError(f"a record claims {length} bytes, the limit is {_MOST}; the file is damaged")
    return length
