"""Recordings of robots, small, written by rosbags: ROS 1 bags, ROS 2 bags and MCAP files of the same messages."""

from __future__ import annotations

import io
import shutil
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as Picture

rosbag1 = pytest.importorskip("rosbags.rosbag1")
rosbag2 = pytest.importorskip("rosbags.rosbag2")
typesys = pytest.importorskip("rosbags.typesys")

SIZE = (12, 16)
EPOCH = 1_700_000_000_123_456_789  # ns: no float64 holds it
STEP = 33_333_333  # ns between depth images
ADDED = {
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "foxglove_msgs/msg/CameraCalibration": (
        "builtin_interfaces/Time timestamp\nstring frame_id\nuint32 width\nuint32 height\nstring distortion_model\n"
        "float64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p"
    ),
}
Entry = tuple[str, int, Any]  # topic, nanoseconds, message


class Types:
    """The messages of one version of ROS, by short calls."""

    def __init__(self, version: int) -> None:
        stores = typesys.Stores
        self.version = version
        self.store = typesys.get_typestore(stores.ROS1_NOETIC if version == 1 else stores.ROS2_HUMBLE)
        for name, text in ADDED.items():
            if name not in self.store.fielddefs:
                self.store.register(typesys.get_types_from_msg(text, name))

    def __call__(self, name: str, /, **fields: Any) -> Any:
        package, short = name.split("/")
        return self.store.types[f"{package}/msg/{short}"](**fields)

    def time(self, stamp: int) -> Any:
        return self("builtin_interfaces/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)

    def header(self, stamp: int, frame: str = "camera_optical") -> Any:
        fields = {"stamp": self.time(stamp), "frame_id": frame}
        return self("std_msgs/Header", **({"seq": 0} if self.version == 1 else {}), **fields)

    def image(
        self, stamp: int, pixels: np.ndarray, encoding: str, frame: str = "camera_optical", *, pad: int = 0
    ) -> Any:
        rows = np.ascontiguousarray(pixels).reshape(len(pixels), -1).view(np.uint8)
        rows = np.pad(rows, ((0, 0), (0, pad)), constant_values=255)
        return self(
            "sensor_msgs/Image",
            header=self.header(stamp, frame),
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=int(pixels.dtype.byteorder == ">"),
            step=rows.shape[1],
            data=rows.reshape(-1),
        )

    def packed(self, stamp: int, data: bytes, form: str, frame: str = "camera_optical") -> Any:
        content = np.frombuffer(data, np.uint8)
        return self("sensor_msgs/CompressedImage", header=self.header(stamp, frame), format=form, data=content)

    def camera_info(self, stamp: int, frame: str = "camera_optical", **changes: Any) -> Any:
        height, width = changes.pop("size", SIZE)
        roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False, **changes.pop("roi", {})}
        k = np.array(changes.pop("k", [20.0, 0, width / 2, 0, 21.0, height / 2, 0, 0, 1]))
        p = np.array(changes.pop("p", [*k[:3], 0, *k[3:6], 0, *k[6:], 0]), np.float64)
        fields = {"d": np.array(changes.pop("d", [0.0] * 5)), "k": k, "r": np.eye(3).reshape(-1), "p": p}
        if self.version == 1:
            fields = {name.upper(): value for name, value in fields.items()}
        return self(
            "sensor_msgs/CameraInfo",
            header=self.header(stamp, frame),
            height=height,
            width=width,
            distortion_model=changes.pop("model", "plumb_bob"),
            binning_x=changes.pop("binning_x", 0),
            binning_y=changes.pop("binning_y", 0),
            roi=self("sensor_msgs/RegionOfInterest", **roi),
            **fields,
            **changes,
        )

    def joints(self, stamp: int, **positions: float) -> Any:
        values = np.array(list(positions.values()), np.float64)
        none = np.empty(0)
        return self(
            "sensor_msgs/JointState",
            header=self.header(stamp, ""),
            name=list(positions),
            position=values,
            velocity=none,
            effort=none,
        )

    def turn(self, xyzw: Any) -> Any:
        x, y, z, w = map(float, xyzw)
        return self("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)

    def transform(self, stamp: int, parent: str, child: str, xyz: Any, xyzw: Any = (0, 0, 0, 1)) -> Any:
        x, y, z = map(float, xyz)
        one = self(
            "geometry_msgs/TransformStamped",
            header=self.header(stamp, parent),
            child_frame_id=child,
            transform=self(
                "geometry_msgs/Transform",
                translation=self("geometry_msgs/Vector3", x=x, y=y, z=z),
                rotation=self.turn(xyzw),
            ),
        )
        return self("tf2_msgs/TFMessage", transforms=[one])

    def pose(self, stamp: int, frame: str, xyz: Any, xyzw: Any = (0, 0, 0, 1)) -> Any:
        x, y, z = map(float, xyz)
        pose = self(
            "geometry_msgs/Pose", position=self("geometry_msgs/Point", x=x, y=y, z=z), orientation=self.turn(xyzw)
        )
        return self("geometry_msgs/PoseStamped", header=self.header(stamp, frame), pose=pose)

    def text(self, words: str) -> Any:
        return self("std_msgs/String", data=words)

    def numbers(self, values: Any) -> Any:
        layout = self("std_msgs/MultiArrayLayout", dim=[], data_offset=0)
        return self("std_msgs/Float64MultiArray", layout=layout, data=np.asarray(values, np.float64).reshape(-1))


def png(pixels: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Picture.fromarray(pixels).save(stream, "PNG")
    return stream.getvalue()


def packed_depth(units: np.ndarray, a: float = 0.0, b: float = 0.0) -> bytes:
    """What compressed_depth_image_transport writes: a header of twelve bytes, then a PNG."""
    return struct.pack("<iff", 0, a, b) + png(units)


def packed_rvl(pixels: np.ndarray) -> bytes:
    """Pack as the paper does, one nibble after another."""
    nibbles: list[int] = []

    def put(value: int) -> None:
        while True:
            low, value = value & 7, value >> 3
            nibbles.append(low | (8 if value else 0))
            if not value:
                return

    flat, place, last = pixels.reshape(-1).astype(int).tolist(), 0, 0
    while place < len(flat):
        for is_reading in (False, True):
            start = place
            while place < len(flat) and bool(flat[place]) == is_reading:
                place += 1
            put(place - start)
        for value in flat[start:place]:
            delta, last = value - last, value
            put((delta << 1) ^ (delta >> 31))
    nibbles += [0] * (-len(nibbles) % 8)
    words = [int("".join(f"{one:x}" for one in nibbles[at : at + 8]), 16) for at in range(0, len(nibbles), 8)]
    return struct.pack(f"<{len(words)}I", *words)


def depth_of(number: int) -> np.ndarray:
    units = np.random.default_rng(number).integers(400, 1400, SIZE).astype(np.uint16)
    units[0, :3] = 0
    return units


def color_of(number: int) -> np.ndarray:
    return np.random.default_rng(100 + number).integers(0, 256, (*SIZE, 3)).astype(np.uint8)


def recording(make: Types, *, count: int = 4) -> list[Entry]:
    """Aligned depth and color, joints at 100 Hz in an order that changes, and a camera on a moving arm."""
    entries: list[Entry] = []
    for number in range(count):
        stamp = EPOCH + number * STEP
        late = stamp + 4_000_000
        entries.append(("/cam/depth/image_raw", late, make.image(stamp, depth_of(number), "16UC1")))
        entries.append(("/cam/depth/camera_info", late, make.camera_info(stamp)))
        entries.append(("/cam/color/image_raw", late, make.image(stamp + 5_000_000, color_of(number), "rgb8")))
        entries.append(("/cam/color/camera_info", late, make.camera_info(stamp)))
    for number in range(-2, 4 * count + 2):
        stamp = EPOCH + number * 10_000_000
        named = {"a": 0.001 * number, "b": 1.0 - 0.002 * number}
        named = named if number % 2 else dict(reversed(named.items()))
        entries.append(("/joint_states", stamp + 1_000_000, make.joints(stamp, **named)))
        angle = 0.01 * number
        turn = (0, 0, np.sin(angle / 2), np.cos(angle / 2))
        entries.append(("/tf", stamp, make.transform(stamp, "base", "hand", (0.1 * number, 0, 0.5), turn)))
    entries.append(("/tf_static", EPOCH - 10**9, make.transform(0, "hand", "camera_optical", (0, 0.2, 0))))
    return entries


def written(path: Path, entries: list[Entry], make: Types, *, form: str = "mcap", packed: bool = False) -> Path:
    """Write a recording: "bag", a file; "mcap", a file; "db3" or "folder", the folder of a ROS 2 bag."""
    path.parent.mkdir(parents=True, exist_ok=True)
    ordered = sorted(entries, key=lambda entry: entry[1])
    if form == "bag":
        writer = rosbag1.Writer(path)
        if packed:
            writer.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
        serialize, folder = make.store.serialize_ros1, path
    else:
        folder = path.with_name(f"{path.name}.folder") if form == "mcap" else path
        plugin = rosbag2.StoragePlugin.SQLITE3 if form == "db3" else rosbag2.StoragePlugin.MCAP
        writer = rosbag2.Writer(folder, version=9, storage_plugin=plugin)
        if packed:
            writer.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
        serialize = make.store.serialize_cdr
    with writer:
        known: dict[str, Any] = {}
        for topic, time, message in ordered:
            kind = message.__msgtype__
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=make.store)
            writer.write(known[topic], time, serialize(message, kind))
    if form == "mcap":
        (file,) = folder.glob("*.mcap")
        file.rename(path)
        shutil.rmtree(folder)
    return path
