"""ROS 1 bags that say of themselves what is not so."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from pcdata.errors import CaptureError
from pcdata.io.messages.bag_file import MAGIC, BagFile
from pcdata.io.messages.log_file import Index
from pcdata.io.messages.packing import MAX_CHUNK


def record(data: bytes, **fields: bytes) -> bytes:
    parts = [name.encode() + b"=" + value for name, value in fields.items()]
    head = b"".join(struct.pack("<I", len(part)) + part for part in parts)
    return struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data


TYPE = struct.pack("<I", 18) + b"type=std_msgs/Bool"
CONNECTION = record(TYPE, op=b"\x07", conn=bytes(4), topic=b"/a")
MESSAGE = record(b"abc", op=b"\x02", conn=bytes(4), time=struct.pack("<II", 1, 5))
INDEX = {"op": b"\x04", "ver": struct.pack("<I", 1), "conn": bytes(4), "count": struct.pack("<I", 1)}


def bag(
    *, chunk: bytes, infos: int = 1, chunk_count: int | None = None, conn_count: int = 1, shift: int = 0, at: int = 0
) -> bytes:
    def head(index_pos: int) -> bytes:
        counts = {"conn_count": struct.pack("<I", conn_count), "chunk_count": struct.pack("<I", chunk_count or infos)}
        return MAGIC + record(b" " * 50, op=b"\x03", index_pos=struct.pack("<Q", index_pos), **counts)

    place = len(head(0))
    index = record(struct.pack("<III", 1, 5, len(CONNECTION) + at), **INDEX)
    info = record(b"", op=b"\x06", ver=struct.pack("<I", 1), chunk_pos=struct.pack("<Q", place + shift), count=bytes(4))
    return head(place + len(chunk) + len(index)) + chunk + index + CONNECTION + info * infos


def packed(
    content: bytes = CONNECTION + MESSAGE, compression: bytes = b"none", size: int = len(CONNECTION + MESSAGE)
) -> bytes:
    return record(content, op=b"\x05", compression=compression, size=struct.pack("<I", size))


def indexed(path: Path, data: bytes) -> Index:
    path.write_bytes(data)
    return BagFile(path).index()


def test_a_whole_index_tells_where_its_messages_are(tmp_path: Path) -> None:
    found = indexed(tmp_path / "a.bag", bag(chunk=packed()))
    assert found.topics == {"/a": ("std_msgs/msg/Bool", "ros1")}
    assert found.damage is None
    assert [times.tolist() for times in found.times["/a"]] == [[1_000_000_005]]
    with BagFile(tmp_path / "a.bag").opened() as read:
        assert read(tuple(found.places["/a"][0][0].tolist()), None) == b"abc"


HOSTILE = {
    "one chunk named twice": (bag(chunk=packed(), infos=2), "twice"),
    "a chunk outside": (bag(chunk=packed(), shift=10**9), "a record should be at byte 1000"),
    "a chunk that is none": (bag(chunk=packed(), shift=-70), "kind|damaged|header"),
    "more chunks than there are": (bag(chunk=packed(), chunk_count=1 << 31), "cut short"),
    "more connections than there are": (bag(chunk=packed(), conn_count=1 << 31), "kind"),
    "a chunk of gigabytes": (bag(chunk=packed(compression=b"lz4", size=MAX_CHUNK + 1)), "limit"),
    "another compression": (bag(chunk=packed(compression=b"zip")), "packed with"),
    "no bag": (b"hello" * 100, "does not start"),
    "no index": (bag(chunk=packed()).replace(b"index_pos=", b"index_poz=", 1), "no number"),
    "a message outside its chunk": (bag(chunk=packed(), at=1000), "leads out of it"),
    "a header without end": (MAGIC + struct.pack("<I", 1 << 31), "header of"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_an_index_that_leads_astray_is_told_with_what_is_wrong(tmp_path: Path, name: str) -> None:
    data, words = HOSTILE[name]
    with pytest.raises(CaptureError, match=words):
        raise CaptureError(indexed(tmp_path / "a.bag", data).damage)


def test_a_bag_that_ends_anywhere_gives_its_message_or_is_refused(tmp_path: Path) -> None:
    data = bag(chunk=packed())
    end = data.index(b"abc") + 3
    for length in range(1, len(data)):
        try:
            found = indexed(tmp_path / "a.bag", data[:length])
        except CaptureError:
            continue
        assert found.damage is not None
        assert length >= end
