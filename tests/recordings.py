"""Recordings of a RealSense, small and made of their messages."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

rosbag1 = pytest.importorskip("rosbags.rosbag1")
typesys = pytest.importorskip("rosbags.typesys")

TYPES = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
DEPTH, COLOR = "/device_0/sensor_0/Depth_0", "/device_0/sensor_1/Color_0"
SIZE = (24, 32)
SHIFT = 0.02  # metres from the depth to the color camera, along x
MILLISECOND = 1_000_000


def types(name: str):
    return TYPES.types[name]


def header():
    return types("std_msgs/msg/Header")(0, types("builtin_interfaces/msg/Time")(1, 0), "0")


def image(pixels: np.ndarray, encoding: str, *, pad: int = 0):
    rows = pixels.reshape(len(pixels), -1).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, pad)))
    big = pixels.dtype.byteorder == ">"
    return types("sensor_msgs/msg/Image")(
        header(), pixels.shape[0], pixels.shape[1], encoding, int(big), rows.shape[1], rows.reshape(-1)
    )


def camera_info(focal: float, lens: tuple[float, ...] = (0.0,) * 5, model: str = "Brown Conrady"):
    k = np.array([focal, 0, SIZE[1] / 2, 0, focal, SIZE[0] / 2, 0, 0, 1.0])
    roi = types("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False)
    return types("sensor_msgs/msg/CameraInfo")(
        header(), SIZE[0], SIZE[1], model, np.array(lens), k, np.zeros(9), np.zeros(12), 0, 0, roi
    )


def transform(x: float):
    return types("geometry_msgs/msg/Transform")(
        types("geometry_msgs/msg/Vector3")(x, 0.0, 0.0), types("geometry_msgs/msg/Quaternion")(0.0, 0.0, 0.0, 1.0)
    )


def recording() -> list[tuple[str, int, object]]:
    """Topic, nanoseconds, message: three depth images, 5 cm apart in depth, and two color images."""
    info = types("diagnostic_msgs/msg/KeyValue")
    messages = [
        ("/device_0/info", 1, info("Name", "Intel RealSense D435")),
        ("/device_0/info", 1, info("Serial Number", "42")),
        (f"{DEPTH}/info/camera_info", 1, camera_info(30.0)),
        (f"{COLOR}/info/camera_info", 1, camera_info(30.0)),
        ("/device_0/sensor_0/option/Depth Units/value", 1, types("std_msgs/msg/Float32")(0.00025)),
        (f"{DEPTH}/tf/0", 1, transform(0.0)),
        (f"{COLOR}/tf/0", 1, transform(SHIFT)),
    ]
    for number in range(3):
        units = np.full(SIZE, 4000 + 200 * number, np.uint16)
        units[:2] = 0
        messages.append((f"{DEPTH}/image/data", (100 + 33 * number) * MILLISECOND, image(units, "mono16")))
    for number in range(2):
        pixels = np.full((*SIZE, 3), 50 * number, np.uint8)
        pixels[..., 0] = np.arange(SIZE[1])
        messages.append((f"{COLOR}/image/data", (105 + 33 * number) * MILLISECOND, image(pixels, "rgb8")))
    return messages


def written(path: Path, messages: list[tuple[str, int, object]]) -> Path:
    with rosbag1.Writer(path) as writer:
        known = {}
        for topic, time, message in messages:
            kind = message.__msgtype__
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=TYPES)
            writer.write(known[topic], time, TYPES.serialize_ros1(message, kind))
    return path
