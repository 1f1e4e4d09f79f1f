"""ROS 1 bags: records, chunks of them, and an index at the end; read by the index, or through where it is missing.

Source: http://wiki.ros.org/Bags/Format/2.0
"""

from __future__ import annotations

import re
from typing import BinaryIO

import numpy as np

from pcdata.errors import CaptureError
from pcdata.io.messages.byte_fields import Fields
from pcdata.io.messages.chunked_file import IN_FILE, ChunkedFile
from pcdata.io.messages.log_file import MAX_MESSAGE, Index, Place, by_topic, type_name
from pcdata.io.messages.packing import check_packing, unpacked

MAGIC = b"#ROSBAG V2.0\n"
_MAX_HEADER = 1 << 20  # bytes of names and values before a record's data
_MESSAGE, _BAG, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
_ENTRY = np.dtype([("seconds", "<u4"), ("nanoseconds", "<u4"), ("offset", "<u4")])

_TOPIC = re.compile(rb"topic=([/\w. -]+)")
_SEARCHED = 1 << 20  # bytes of a bag without an index

Rows = dict[str, list[tuple[int, int, int]]]


class BagFile(ChunkedFile):
    """One .bag file."""

    suffix = ".bag"
    container = "ROS 1 bag"
    magic = MAGIC
    begins_as = "a ROS 1 bag of version 2.0"

    def _indexed(self, stream: BinaryIO, size: int) -> Index:
        return _Indexer(stream, size).index()

    def _seek_message(self, stream: BinaryIO, start: int, size: int) -> int:
        length = _Record(stream, start, size).check(_MESSAGE).length
        if length > MAX_MESSAGE:
            raise CaptureError(f"{self.path}: a message claims {length} bytes, the limit is {MAX_MESSAGE}")
        return length

    def _unpacked_chunk(self, stream: BinaryIO, start: int, size: int) -> bytes:
        return _unpacked_chunk(stream, _Record(stream, start, size).check(_CHUNK))

    def _skip_to_message(self, chunk: Fields, start: int) -> int:
        header_fields(chunk.take(chunk.number("I")), _MESSAGE)
        length = chunk.number("I")
        if length > chunk.left:
            raise CaptureError(f"{self.path}: a message leads out of its chunk at byte {start}; it is damaged")
        return length


def bag_topics(stream: BinaryIO, size: int) -> list[str]:
    """Return the names of the topics of a bag, without its messages; of one without an index those that begin it."""
    stream.seek(0)
    if stream.read(len(MAGIC)) != MAGIC:
        return []
    indexer = _Indexer(stream, size)
    try:
        indexer.read_connections(_Record(stream, len(MAGIC), size).check(_BAG))
        return indexer.topics
    except CaptureError:
        stream.seek(0)
        return [name.decode() for name in _TOPIC.findall(stream.read(_SEARCHED))]


def header_fields(content: bytes, expected: int | None = None) -> dict[bytes, bytes]:
    """Return the names and values of a record's header.

    Raises:
        CaptureError: it is damaged, or of another kind than expected.
    """
    fields, rest = dict[bytes, bytes](), Fields(content)
    while rest.left:
        name, equals, value = rest.take(rest.number("I")).partition(b"=")
        if not equals or name in fields:
            raise CaptureError(f"a record's header has {name[:20]!r} twice or without a value; the bag is damaged")
        fields[name] = value
    if expected is not None and fields.get(b"op") != bytes([expected]):
        raise CaptureError(
            f"a record of kind {fields.get(b'op', b'')[:4]!r} stands where kind {expected} should be; the bag is "
            "damaged"
        )
    return fields


class _Record:
    """The record at a byte of a file: its header, and where its data are; the stream is at these then."""

    def __init__(self, stream: BinaryIO, start: int, size: int, *, whole: bool = True) -> None:
        if not 0 < start < size:
            raise CaptureError(f"a record should be at byte {start} of {size}; the file is cut short")
        stream.seek(start)
        length = _length(stream)
        header = stream.read(length) if length <= _MAX_HEADER else b""
        if len(header) != length:
            raise CaptureError(f"a record claims a header of {length} bytes; the bag is damaged or cut short")
        self.header = header
        self.fields = header_fields(header)
        self.length = _length(stream)
        self.begin = start + 8 + length
        self.end = self.begin + self.length
        if whole and self.end > size:
            raise CaptureError(
                f"a record claims {self.length} bytes where {size - self.begin} follow; the bag is cut short"
            )

    @property
    def kind(self) -> int:
        """What the record is."""
        return self.number(b"op", 1)

    def check(self, kind: int) -> _Record:
        """Return the record, which must be of a kind."""
        header_fields(self.header, kind)
        return self

    def number(self, name: bytes, *sizes: int) -> int:
        """Return a whole number of its header."""
        value = self.fields.get(name, b"")
        if len(value) not in (sizes or (4, 8)):
            raise CaptureError(f"a record has no number {name.decode()!r}; the bag is damaged")
        return int.from_bytes(value, "little")


def _length(stream: BinaryIO) -> int:
    content = stream.read(4)
    if len(content) != 4:
        raise CaptureError("it is cut short: a record is missing")
    return int.from_bytes(content, "little")


def _packing(chunk: _Record) -> str:
    return chunk.fields.get(b"compression", b"").decode("ascii", "replace")


def _unpacked_chunk(stream: BinaryIO, chunk: _Record) -> bytes:
    stream.seek(chunk.begin)
    return unpacked(stream.read(chunk.length), _packing(chunk), chunk.number(b"size", 4))


def _time(value: bytes) -> int:
    if len(value) != 8:
        raise CaptureError("a message has no time; the bag is damaged")
    return int.from_bytes(value[:4], "little") * 10**9 + int.from_bytes(value[4:], "little")


class _Indexer:
    """Finds the messages of one open bag."""

    def __init__(self, stream: BinaryIO, size: int) -> None:
        self._stream, self._size = stream, size
        self._topics: dict[int, str] = {}
        self._index = Index()

    def index(self) -> Index:
        """Return what the bag holds."""
        head = _Record(self._stream, len(MAGIC), self._size).check(_BAG)
        try:
            self._read_index(head)
            return self._index
        except CaptureError as error:
            self._topics, self._index = {}, Index()
            return self._scanned(head.end, f"its index cannot be read ({error}), so it was read through")

    @property
    def topics(self) -> list[str]:
        """The names of the topics that were found so far."""
        return sorted(set(self._topics.values()))

    def read_connections(self, head: _Record) -> int:
        """Read what describes the topics; returns where the rest of the index begins.

        Raises:
            CaptureError: there is no index, or it is damaged.
        """
        place = head.number(b"index_pos", 8)
        if place == 0:
            raise CaptureError("there is none, as after a recording that was cut short; 'rosbag reindex' writes it")
        for _ in range(head.number(b"conn_count", 4)):
            record = _Record(self._stream, place, self._size).check(_CONNECTION)
            self._declare(record.fields, self._stream.read(record.length))
            place = record.end
        return place

    def _read_index(self, head: _Record) -> None:
        place, starts = self.read_connections(head), list[int]()
        for _ in range(head.number(b"chunk_count", 4)):
            record = _Record(self._stream, place, self._size).check(_CHUNK_INFO)
            starts.append(record.number(b"chunk_pos", 8))
            place = record.end
        if len(set(starts)) != len(starts):
            raise CaptureError("it names one chunk twice; the bag is damaged")
        for start in starts:
            self._add_chunk(_Record(self._stream, start, self._size).check(_CHUNK), start)

    def _declare(self, fields: dict[bytes, bytes], content: bytes) -> None:
        told = header_fields(content)
        number = int.from_bytes(fields.get(b"conn", b""), "little")
        topic = fields.get(b"topic", b"").decode(errors="replace")
        self._topics[number] = topic
        self._index.add_topic(topic, type_name(told.get(b"type", b"").decode(errors="replace")), "ros1")

    def _topic(self, number: int) -> str:
        if number not in self._topics:
            raise CaptureError(f"it has messages of a connection {number} that it does not describe; it is damaged")
        return self._topics[number]

    def _add_chunk(self, chunk: _Record, start: int) -> None:
        plain, size, place = _packing(chunk) == "none", chunk.number(b"size", 4), chunk.end
        check_packing(_packing(chunk), size if not plain else 0)
        if plain and size != chunk.length:
            raise CaptureError(f"a chunk of {chunk.length} bytes claims {size}; the bag is damaged")
        while place < self._size:
            record = _Record(self._stream, place, self._size)
            if record.kind != _INDEX:
                break
            topic = self._topic(record.number(b"conn", 4))
            rows = np.frombuffer(self._stream.read(record.length), _ENTRY)
            if len(rows) and rows["offset"].max() >= size:
                raise CaptureError(f"the index of the chunk at byte {start} leads out of it; the bag is damaged")
            places = np.empty((len(rows), 2), np.int64)
            places[:, 0] = chunk.begin + rows["offset"].astype(np.int64) if plain else start
            places[:, 1] = IN_FILE if plain else rows["offset"]
            times = rows["seconds"].astype(np.int64) * 10**9 + rows["nanoseconds"]
            self._index.add(topic, times, places)
            place = record.end

    # -- without an index ----------------------------------------------------------------------------------------------

    def _scanned(self, place: int, damage: str) -> Index:
        """Read through the bag, as far as it can be read."""
        found: Rows = {}
        try:
            while place < self._size:
                record = _Record(self._stream, place, self._size, whole=False)
                if record.kind == _CHUNK:
                    self._scan_chunk(record, place, found)
                elif record.kind == _CONNECTION:
                    self._declare(record.fields, self._stream.read(record.length))
                if record.end > self._size:
                    raise CaptureError("the last record is cut short")
                place = record.end
        except (CaptureError, ValueError) as error:
            count = sum(map(len, found.values()))
            damage = f"{damage}, up to byte {place} of {self._size}: {count} messages, then {error}"
        if not found:
            raise CaptureError(f"no message can be read: {damage}")
        by_topic(found, self._index)
        self._index.damage = damage
        return self._index

    def _scan_chunk(self, chunk: _Record, start: int, found: Rows) -> None:
        if _packing(chunk) == "none":
            place = chunk.begin
            while place < min(chunk.end, self._size):
                record = _Record(self._stream, place, self._size)
                if record.kind == _CONNECTION:
                    self._declare(record.fields, self._stream.read(record.length))
                elif record.kind == _MESSAGE:
                    self._note(record.fields, (place, IN_FILE), found)
                place = record.end
            return
        if chunk.end > self._size:
            return
        content = Fields(_unpacked_chunk(self._stream, chunk))
        while content.left:
            place = content.place
            fields = header_fields(content.take(content.number("I")))
            data = content.take(content.number("I"))
            if fields.get(b"op") == bytes([_CONNECTION]):
                self._declare(fields, data)
            elif fields.get(b"op") == bytes([_MESSAGE]):
                self._note(fields, (start, place), found)

    def _note(self, fields: dict[bytes, bytes], place: Place, found: Rows) -> None:
        topic = self._topic(int.from_bytes(fields.get(b"conn", b""), "little"))
        found.setdefault(topic, []).append((_time(fields.get(b"time", b"")), *place))
