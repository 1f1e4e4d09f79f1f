"""Recordings of other programs than ROS: Foxglove's schemas in MCAP, and clouds."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from pcdata import open_source
from pcdata.errors import CaptureError, ConfigError, PcdataError
from tests.ros_recordings import EPOCH, SIZE, Types, color_of, depth_of, png, written

ROS2 = Types(2)
FRAME = "camera_optical"


def record(kind: int, content: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(content)) + content


def text(words: str) -> bytes:
    return struct.pack("<I", len(words)) + words.encode()


def plain_mcap(path: Path, messages: list[tuple[str, str, str, int, bytes]], *, profile: str = "") -> Path:
    """An MCAP file without chunks and without an index: topic, schema, encoding, nanoseconds, bytes."""
    channels: dict[str, int] = {}
    content = b"\x89MCAP0\r\n" + record(1, text(profile) + text("test"))
    for topic, schema, encoding, time, data in messages:
        if topic not in channels:
            number = channels[topic] = len(channels) + 1
            content += record(3, struct.pack("<H", number) + text(schema) + text("") + struct.pack("<I", 0))
            content += record(4, struct.pack("<HH", number, number) + text(topic) + text(encoding) + bytes(4))
        content += record(5, struct.pack("<HIQQ", channels[topic], 0, time, time) + data)
    path.write_bytes(content + record(15, bytes(4)) + record(2, bytes(20)) + b"\x89MCAP0\r\n")
    return path


def varint(value: int) -> bytes:
    found = b""
    while value > 0x7F:
        found, value = found + bytes([value & 0x7F | 0x80]), value >> 7
    return found + bytes([value])


def protobuf(*fields: tuple[int, Any]) -> bytes:
    """Fields by number: bytes and texts, doubles in lists, fixed32 in a tuple, whole numbers."""
    found = b""
    for number, value in fields:
        if isinstance(value, tuple):
            found += varint(number << 3 | 5) + struct.pack("<I", *value)
        elif isinstance(value, int):
            found += varint(number << 3) + varint(value)
        elif isinstance(value, float):
            found += varint(number << 3 | 1) + struct.pack("<d", value)
        else:
            data = value.encode() if isinstance(value, str) else value
            data = struct.pack(f"<{len(data)}d", *data) if isinstance(data, list) else data
            found += varint(number << 3 | 2) + varint(len(data)) + data
    return found


K = [20.0, 0, 8, 0, 21, 6, 0, 0, 1]


def of_protobuf(number: int, stamp: int) -> list[tuple[str, str, str, int, bytes]]:
    time = protobuf((1, stamp // 10**9), (2, stamp % 10**9))
    height, width = SIZE
    raw = protobuf(
        (1, time),
        (2, (width,)),
        (3, (height,)),
        (4, "16UC1"),
        (5, (2 * width,)),
        (6, depth_of(number).tobytes()),
        (7, FRAME),
    )
    packed = protobuf((1, time), (2, png(color_of(number))), (3, "png"), (4, FRAME), (100, "id"))
    lens = protobuf(
        (1, time), (2, (width,)), (3, (height,)), (4, "plumb_bob"), (5, [0.0] * 5), (6, K), (8, [0.0] * 12), (9, FRAME)
    )
    pose = protobuf((1, time), (2, "base"), (3, FRAME), (4, protobuf((1, 0.5), (3, -1.0))), (5, protobuf((4, 1.0))))
    return [
        ("/cam/depth", "foxglove.RawImage", "protobuf", stamp, raw),
        ("/cam/color", "foxglove.CompressedImage", "protobuf", stamp, packed),
        ("/cam/camera_info", "foxglove.CameraCalibration", "protobuf", stamp, lens),
        ("/tf", "foxglove.FrameTransform", "protobuf", stamp, pose),
    ]


def of_json(number: int, stamp: int) -> list[tuple[str, str, str, int, bytes]]:
    height, width = SIZE
    shared = {"timestamp": {"sec": stamp // 10**9, "nsec": stamp % 10**9}, "frame_id": FRAME}

    def packed(data: bytes) -> str:
        return base64.b64encode(data).decode()

    size = {"width": width, "height": height}
    raw = {**shared, **size, "encoding": "16UC1", "step": 2 * width, "data": packed(depth_of(number).tobytes())}
    lens = {**shared, **size, "distortion_model": "", "D": [], "K": K, "R": [], "P": [0] * 12}
    pose = {"timestamp": shared["timestamp"], "parent_frame_id": "base", "child_frame_id": FRAME}
    pose |= {"translation": {"x": 0.5, "y": 0, "z": -1.0}, "rotation": {"x": 0, "y": 0, "z": 0, "w": 1}}
    told: dict[str, tuple[str, dict[str, Any]]] = {
        "/cam/depth": ("RawImage", raw),
        "/cam/color": ("CompressedImage", {**shared, "format": "png", "data": packed(png(color_of(number)))}),
        "/cam/camera_info": ("CameraCalibration", lens),
        "/tf": ("FrameTransform", pose),
    }
    return [
        (topic, f"foxglove.{kind}", "json", stamp, json.dumps(said).encode()) for topic, (kind, said) in told.items()
    ]


@pytest.mark.parametrize("messages", [of_protobuf, of_json])
def test_foxglove_s_messages_are_read_without_its_packages(tmp_path: Path, messages: Any) -> None:
    rows = [row for number in range(3) for row in messages(number, EPOCH + number * 50_000_000)]
    source = open_source(plain_mcap(tmp_path / "a.mcap", rows), frame_id="base")
    assert (source.kind, len(source)) == ("ros", 3)
    frame = source.load("000001")
    assert torch.equal(frame.depth[0], torch.from_numpy((depth_of(1) * 0.001).astype(np.float32)))
    assert torch.equal(frame.colors[0], torch.from_numpy(color_of(1)))
    assert frame.camera.intrinsics[0].reshape(-1).tolist() == K
    assert frame.world_from_camera[0, :3, 3].tolist() == [0.5, 0, -1]
    assert frame.provenance["stamp_ns"] == EPOCH + 50_000_000


def test_ros_1_messages_in_an_mcap_file_are_read(tmp_path: Path) -> None:
    make = Types(1)
    rows = []
    for topic, message in (
        ("/cam/depth", make.image(EPOCH, depth_of(0), "16UC1")),
        ("/cam/camera_info", make.camera_info(EPOCH)),
    ):
        data = bytes(make.store.serialize_ros1(message, message.__msgtype__))
        rows.append((topic, message.__msgtype__.replace("/msg/", "/"), "ros1", EPOCH, data))
    frame = open_source(plain_mcap(tmp_path / "a.mcap", rows, profile="ros1")).load("000000")
    assert torch.equal(frame.depth[0], torch.from_numpy((depth_of(0) * 0.001).astype(np.float32)))


def test_damaged_messages_are_refused_with_their_topic(tmp_path: Path) -> None:
    for messages in (of_protobuf, of_json):
        for cut in range(0, 400, 13):
            rows = [
                (*row[:4], row[4][: len(row[4]) - cut] if row[0] == "/cam/camera_info" else row[4])
                for row in messages(0, EPOCH)
            ]
            if cut:
                with pytest.raises(PcdataError):
                    open_source(plain_mcap(tmp_path / "a.mcap", rows))
    unknown = [(topic, "foxglove.Unknown", "protobuf", time, data) for topic, _, _, time, data in of_protobuf(0, EPOCH)]
    with pytest.raises(CaptureError, match=r"(?s)no topic holds depth.*foxglove.Unknown"):
        open_source(plain_mcap(tmp_path / "a.mcap", unknown))


# -- clouds ------------------------------------------------------------------------------------------------------------


def cloud_message(points: np.ndarray, colors: np.ndarray, *, pad: int = 0, row_pad: int = 0, big: bool = False) -> Any:
    """(H, W, 3) points and uint8 colors, packed as PCL packs them: x y z, a gap, rgb in a float."""
    height, width = points.shape[:2]
    order = ">" if big else "<"
    step = 20 + pad
    rows = np.full((height, width * step + row_pad), 7, np.uint8)
    cells = rows[:, : width * step].reshape(height, width, step)
    cells[..., :12] = np.ascontiguousarray(points.astype(f"{order}f4")).view(np.uint8).reshape(height, width, 12)
    packed = (colors.astype(np.uint32) << np.array([16, 8, 0], np.uint32)).sum(-1).astype(f"{order}u4")
    cells[..., 16:20] = packed[..., None].view(np.uint8)
    field = [
        ROS2("sensor_msgs/PointField", name=n, offset=o, datatype=7, count=1)
        for n, o in (("x", 0), ("y", 4), ("z", 8), ("rgb", 16))
    ]
    return ROS2(
        "sensor_msgs/PointCloud2", header=ROS2.header(EPOCH, "lidar"), height=height, width=width, fields=field,
        is_bigendian=big, point_step=step, row_step=rows.shape[1], data=rows.reshape(-1), is_dense=False,
    )  # fmt: skip


@pytest.mark.parametrize("layout", [{}, {"pad": 12, "row_pad": 5}, {"big": True}])
@pytest.mark.parametrize("height", [1, 4])
def test_clouds_are_read_however_their_bytes_lie(tmp_path: Path, layout: dict[str, Any], height: int) -> None:
    draw = np.random.default_rng(0)
    points = draw.uniform(-1, 1, (height, 6, 3)).astype(np.float32)
    points[0, 2] = np.nan
    colors = draw.integers(0, 256, (height, 6, 3)).astype(np.uint8)
    path = written(tmp_path / "a.mcap", [("/points", EPOCH, cloud_message(points, colors, **layout))], ROS2)
    source = open_source(path)
    cloud = source.load("000000")
    keep = np.isfinite(points).all(-1)
    assert torch.equal(cloud.points, torch.from_numpy(points[keep]))
    assert torch.equal((cloud.colors * 255).round().to(torch.uint8), torch.from_numpy(colors[keep]))
    assert torch.equal(cloud.source_index, torch.from_numpy(np.flatnonzero(keep.reshape(-1))))
    assert cloud.frame_id == "lidar"
    assert cloud.meta[0].get("organized_size") == ([4, 6] if height == 4 else None)
    assert cloud.meta[0]["provenance"]["stamp_ns"] == EPOCH
    assert source.episodes[0].length == 1


def test_clouds_that_contradict_themselves_are_refused(tmp_path: Path) -> None:
    whole = cloud_message(np.full((2, 3, 3), 0.5, np.float32), np.zeros((2, 3, 3), np.uint8))
    for changes in (
        {"point_step": 0},
        {"row_step": 3},
        {"width": 1 << 31, "height": 1 << 31},
        {"fields": []},
        {"data": whole.data[:50]},
    ):
        message = SimpleNamespace(**{**vars(whole), **changes})
        from pcdata.io.messages.point_clouds import cloud_of

        with pytest.raises(CaptureError):
            cloud_of("here", message, frame_id="lidar")
    path = written(tmp_path / "a.mcap", [("/points", EPOCH, whole)], ROS2)
    with pytest.raises(ConfigError, match="did you mean '/points'"):
        open_source(path, cloud="/point")
    with pytest.raises(ConfigError, match="both named"):
        open_source(path, cloud="/points", depth="/points")
