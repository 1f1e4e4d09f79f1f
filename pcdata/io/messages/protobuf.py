"""Foxglove's messages in protobuf, without its package: a table of field numbers, and the wire format.

Source: https://protobuf.dev/programming-guides/encoding; Foxglove, schemas/proto/foxglove.
"""

from __future__ import annotations

import struct
from types import SimpleNamespace
from typing import Any

import numpy as np

from pcdata.errors import CaptureError

_Table = dict[int, tuple[str, str]]  # number: name, and what it is; "*" = any number of them
_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5
_MOST = 1 << 20  # transforms in a message, or numbers of a lens

_TIME: _Table = {1: ("sec", "int"), 2: ("nanosec", "int")}
_VECTOR: _Table = {1: ("x", "double"), 2: ("y", "double"), 3: ("z", "double")}
_MESSAGES: dict[str, _Table] = {
    "foxglove.Timestamp": _TIME,
    "foxglove.Vector3": _VECTOR,
    "foxglove.Quaternion": {**_VECTOR, 4: ("w", "double")},
    "foxglove.CompressedImage": {
        1: ("timestamp", "foxglove.Timestamp"), 2: ("data", "bytes"), 3: ("format", "text"), 4: ("frame_id", "text"),
    },
    "foxglove.RawImage": {
        1: ("timestamp", "foxglove.Timestamp"), 2: ("width", "fixed32"), 3: ("height", "fixed32"),
        4: ("encoding", "text"), 5: ("step", "fixed32"), 6: ("data", "bytes"), 7: ("frame_id", "text"),
    },
    "foxglove.CameraCalibration": {
        1: ("timestamp", "foxglove.Timestamp"), 2: ("width", "fixed32"), 3: ("height", "fixed32"),
        4: ("distortion_model", "text"), 5: ("d", "double*"), 6: ("k", "double*"), 7: ("r", "double*"),
        8: ("p", "double*"), 9: ("frame_id", "text"),
    },
    "foxglove.FrameTransform": {
        1: ("timestamp", "foxglove.Timestamp"), 2: ("parent_frame_id", "text"), 3: ("child_frame_id", "text"),
        4: ("translation", "foxglove.Vector3"), 5: ("rotation", "foxglove.Quaternion"),
    },
    "foxglove.FrameTransforms": {1: ("transforms", "foxglove.FrameTransform*")},
}  # fmt: skip
_EMPTY: dict[str, Any] = {"int": 0, "double": 0.0, "fixed32": 0, "text": "", "bytes": np.empty(0, np.uint8)}


def protobuf_fields(kind: str, content: bytes) -> Any:
    """Return the fields of a message by name; those that are left out have their default, as protobuf has it.

    Raises:
        CaptureError: no such type, or the bytes are damaged.
    """
    if kind not in _MESSAGES:
        raise CaptureError(f"protobuf of the type {kind!r:.100} is not known; Foxglove's camera messages are")
    return _parsed(kind, memoryview(content))


def timestamp_at_start(content: bytes) -> int | None:
    """Return the nanoseconds of a message that begins with its time, as every writer writes it; None = it does not."""
    if len(content) < 2 or content[0] != (1 << 3 | _BYTES) or len(content) < 2 + content[1]:
        return None
    time = _parsed("foxglove.Timestamp", memoryview(content)[2 : 2 + content[1]])
    return int(time.sec) * 10**9 + int(time.nanosec)


def _parsed(kind: str, content: memoryview) -> SimpleNamespace:
    table = _MESSAGES[kind]
    found: dict[str, Any] = {name: _default(what) for name, what in table.values()}
    place = 0
    while place < len(content):
        key, place = _varint(content, place)
        number, wire = key >> 3, key & 7
        value: Any
        if wire == _VARINT:
            value, place = _varint(content, place)
        elif wire in (_EIGHT, _FOUR):
            size = 8 if wire == _EIGHT else 4
            value, place = content[place : place + size], place + size
        elif wire == _BYTES:
            size, place = _varint(content, place)
            value, place = content[place : place + size], place + size
        else:
            raise CaptureError(f"a {kind} has a field of the wire type {wire}; it is damaged")
        if place > len(content):
            raise CaptureError(f"a {kind} ends within a field; it is damaged")
        if number in table:
            name, what = table[number]
            _put(found, name, what, wire, value)
    return SimpleNamespace(**found)


def _default(what: str) -> Any:
    if what.endswith("*"):
        return []
    return _EMPTY[what] if what in _EMPTY else _parsed(what, memoryview(b""))


def _put(found: dict[str, Any], name: str, what: str, wire: int, value: Any) -> None:
    kind = what.removesuffix("*")
    if kind == "double" and wire == _BYTES and what != kind:  # packed, as every writer does
        if len(value) % 8:
            raise CaptureError(f"{name} has {len(value)} bytes, which are no doubles; it is damaged")
        read: list[Any] = np.frombuffer(value, "<f8").tolist()
    elif kind == "double" and wire == _EIGHT:
        read = [struct.unpack("<d", value)[0]]
    elif kind == "fixed32" and wire == _FOUR:
        read = [struct.unpack("<I", value)[0]]
    elif kind == "int" and wire == _VARINT:
        read = [value]
    elif kind == "text" and wire == _BYTES:
        try:
            read = [bytes(value).decode()]
        except UnicodeDecodeError as error:
            raise CaptureError(f"{name} is no UTF-8; it is damaged") from error
    elif kind == "bytes" and wire == _BYTES:
        read = [np.frombuffer(value, np.uint8)]
    elif kind in _MESSAGES and wire == _BYTES:
        read = [_parsed(kind, value)]
    else:
        raise CaptureError(f"{name} must be {kind}, but has the wire type {wire}; it is damaged")
    if kind == what:
        found[name] = read[-1]
        return
    found[name] += read
    if len(found[name]) > _MOST:
        raise CaptureError(f"{name} has more than {_MOST} values; it is damaged")


def _varint(content: memoryview, place: int) -> tuple[int, int]:
    value = 0
    for count in range(10):
        if place + count >= len(content):
            raise CaptureError("a number ends too early; the message is damaged")
        byte = content[place + count]
        value |= (byte & 0x7F) << (7 * count)
        if byte < 0x80:
            return value, place + count + 1
    raise CaptureError("a number has more than ten bytes; the message is damaged")
