"""From the bytes of a message to its fields: ROS 1 and ROS 2 through rosbags, Foxglove's schemas as JSON and protobuf.

The types that are known here are used alone: what a file says of its own types would have to be compiled from it. So a
message's fields are called as ROS 2 calls them, whatever it came in: ``header.stamp``, ``header.frame_id``, ``k``.

Source: rosbags' standard types; Foxglove, schemas/proto/foxglove and schemas/jsonschema.
"""

from __future__ import annotations

import base64
import binascii
import importlib
import struct
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np

from pcdata.errors import CaptureError
from pcdata.extras import require
from pcdata.files.strict_json import parse_json
from pcdata.io.messages.log_file import Topic
from pcdata.io.messages.protobuf import protobuf_fields, timestamp_at_start

# Types that rosbags does not bring for every version of ROS.
_ADDED = {
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "tf/msg/tfMessage": "geometry_msgs/TransformStamped[] transforms",
    "foxglove_msgs/msg/CompressedImage": (
        "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format"
    ),
    "foxglove_msgs/msg/RawImage": (
        "builtin_interfaces/Time timestamp\nstring frame_id\nuint32 width\nuint32 height\nstring encoding\n"
        "uint32 step\nuint8[] data"
    ),
    "foxglove_msgs/msg/CameraCalibration": (
        "builtin_interfaces/Time timestamp\nstring frame_id\nuint32 width\nuint32 height\nstring distortion_model\n"
        "float64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p"
    ),
    "foxglove_msgs/msg/FrameTransform": (
        "builtin_interfaces/Time timestamp\nstring parent_frame_id\nstring child_frame_id\n"
        "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation"
    ),
    "foxglove_msgs/msg/FrameTransforms": "foxglove_msgs/FrameTransform[] transforms",
}
_FOXGLOVE = ("foxglove.", "foxglove_msgs/msg/")
ENCODINGS = ("cdr", "ros1", "json", "protobuf")
HEADED = (  # types whose first field is a header, with the time and the frame
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/CameraInfo",
    "sensor_msgs/msg/JointState",
    "sensor_msgs/msg/PointCloud2",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PointStamped",
    "geometry_msgs/msg/TwistStamped",
    "geometry_msgs/msg/Vector3Stamped",
    "geometry_msgs/msg/WrenchStamped",
    "nav_msgs/msg/Odometry",
    "foxglove_msgs/msg/CompressedImage",  # theirs begin with the time
    "foxglove_msgs/msg/RawImage",
    "foxglove_msgs/msg/CameraCalibration",
)


def plain_type(kind: str) -> str:
    """Return the type under which the two ways of writing Foxglove's are one: "foxglove.RawImage"."""
    return f"foxglove.{kind.rpartition('/')[2]}" if kind.startswith("foxglove_msgs/msg/") else kind


def is_known(topic: Topic) -> bool:
    """Say whether messages of a topic can be decoded."""
    if topic.encoding in ("json", "protobuf"):
        return plain_type(topic.type).removeprefix("foxglove.") in _JSON_BYTES
    return topic.encoding in ("cdr", "ros1") and topic.type in _types(topic.encoding).fielddefs


def decoded(topic: Topic, content: bytes) -> Any:
    """Return the message that bytes are.

    Raises:
        CaptureError: they are none, or of a type that is not known.
        MissingExtraError: rosbags is not installed.
    """
    try:
        if topic.encoding == "cdr":
            message = _types("cdr").deserialize_cdr(content, topic.type)
        elif topic.encoding == "ros1":
            message = _types("ros1").deserialize_ros1(content, topic.type)
        elif topic.encoding == "json":
            message = _of_json(plain_type(topic.type), content)
        elif topic.encoding == "protobuf":
            message = protobuf_fields(plain_type(topic.type), content)
        else:
            raise CaptureError(
                f"topic {topic.name} is encoded as {topic.encoding!r:.50}; known are {', '.join(ENCODINGS)}"
            )
    except CaptureError:
        raise
    except Exception as error:  # generated parsers raise many types on damaged bytes
        raise CaptureError(
            f"a message of topic {topic.name} is no {topic.type}: {type(error).__name__}: {str(error)[:200]}"
        ) from error
    return _with_header(message) if topic.type.startswith(_FOXGLOVE) else message


def stamp_of(topic: Topic, start: bytes) -> int | None:
    """Return the nanoseconds of a message's header from its first bytes; None = its type has none there.

    Raises:
        CaptureError: the message is cut short.
    """
    if topic.encoding == "protobuf" and plain_type(topic.type).startswith("foxglove."):
        return timestamp_at_start(start)
    if topic.type not in HEADED or topic.encoding not in ("cdr", "ros1"):
        return None
    if len(start) < 12:
        raise CaptureError(f"a message of topic {topic.name} is cut short")
    if topic.encoding == "ros1":
        seconds, nanoseconds = struct.unpack_from("<II", start, 0 if topic.type.startswith(_FOXGLOVE) else 4)
    else:
        seconds, nanoseconds = struct.unpack_from("<iI" if start[1] & 1 else ">iI", start, 4)
    return int(seconds) * 10**9 + int(nanoseconds)


def stamp(message: Any) -> int:
    """Return the nanoseconds of a message's header."""
    time = message.header.stamp
    return int(time.sec) * 10**9 + int(time.nanosec)


@cache
def _types(encoding: str) -> Any:
    require("rosbags")
    typesys = importlib.import_module("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if encoding == "ros1" else typesys.Stores.ROS2_HUMBLE)
    for name, text in _ADDED.items():
        if name not in store.fielddefs:
            store.register(typesys.get_types_from_msg(text, name))
    return store


# -- Foxglove's schemas ------------------------------------------------------------------------------------------------

_JSON_BYTES = {  # by type: the fields that are bytes, which JSON has as base64
    "CompressedImage": ("data",),
    "RawImage": ("data",),
    "CameraCalibration": (),
    "FrameTransform": (),
    "FrameTransforms": (),
}


def _of_json(kind: str, content: bytes) -> Any:
    name = kind.removeprefix("foxglove.")
    if not kind.startswith("foxglove.") or name not in _JSON_BYTES:
        raise CaptureError(f"JSON of the type {kind!r:.100} is not known")
    try:
        message = _namespace(parse_json(content))
        for field in _JSON_BYTES[name]:
            packed = base64.b64decode(getattr(message, field), validate=True)
            setattr(message, field, np.frombuffer(packed, np.uint8))
    except (ValueError, binascii.Error, AttributeError, TypeError) as error:
        raise CaptureError(f"a message is no {kind} in JSON: {str(error)[:200]}") from error
    return message


def _namespace(value: Any) -> Any:
    if isinstance(value, dict):
        return SimpleNamespace(**{key: _namespace(part) for key, part in value.items()})
    return [_namespace(part) for part in value] if isinstance(value, list) else value


def _with_header(message: Any) -> Any:
    """Return a message of Foxglove's with the names of ROS: a header, and lower-case matrices."""
    transforms = getattr(message, "transforms", None)
    if transforms is not None:
        return SimpleNamespace(transforms=[_with_header(one) for one in transforms])
    fields = {name.lower(): value for name, value in vars(message).items()}
    time = fields.get("timestamp") or SimpleNamespace(sec=0, nanosec=0)
    nanoseconds = getattr(time, "nsec", getattr(time, "nanosec", 0))
    frame = fields.get("frame_id", fields.get("parent_frame_id", ""))
    fields["header"] = SimpleNamespace(stamp=SimpleNamespace(sec=time.sec, nanosec=nanoseconds), frame_id=frame)
    if "translation" in fields:
        fields["transform"] = SimpleNamespace(translation=fields["translation"], rotation=fields["rotation"])
    fields.setdefault("is_bigendian", 0)
    return SimpleNamespace(**fields)
