"""A robot's recording, without ROS: depth at 10 Hz and joints at 20 Hz, joined at the time of each image."""

import tempfile
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import pcdata

store = get_typestore(Stores.ROS2_HUMBLE)
Time, Header, Image, CameraInfo, Region, JointState = (
    store.types[name]
    for name in (
        "builtin_interfaces/msg/Time", "std_msgs/msg/Header", "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo",
        "sensor_msgs/msg/RegionOfInterest", "sensor_msgs/msg/JointState",
    )
)  # fmt: skip
k, none, start = np.array([60.0, 0, 32, 0, 60, 24, 0, 0, 1]), np.empty(0), 1_700_000_000

# What a robot records, here written by hand: a folder with take.mcap and metadata.yaml.
folder = Path(tempfile.mkdtemp()) / "take"
with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
    topics = {}
    for step in range(20):  # 0.05 s each; images lie between two messages of the joints
        head = Header(Time(start, step * 50_000_000), "")
        messages = {"/joint_states": JointState(head, ["elbow"], np.array([0.1 * step]), none, none)}
        if step % 2:
            head = Header(Time(start, step * 50_000_000 + 25_000_000), "wrist_optical_frame")
            units = np.full((48, 64), 700 + 10 * step, np.uint16)  # 16UC1: millimetres
            messages["/wrist/depth/image_raw"] = Image(head, 48, 64, "16UC1", 0, 128, units.view(np.uint8).reshape(-1))
            lens = (48, 64, "plumb_bob", none, k, np.eye(3).reshape(-1), np.zeros(12), 0, 0, Region(0, 0, 0, 0, False))
            messages["/wrist/depth/camera_info"] = CameraInfo(head, *lens)
        for topic, message in messages.items():
            kind = message.__msgtype__
            topics[topic] = topics.get(topic) or writer.add_connection(topic, kind, typestore=store)
            writer.write(topics[topic], start * 10**9 + step * 50_000_000, store.serialize_cdr(message, kind))

source = pcdata.open_source(folder)  # or the .mcap in it; what may be said of it: docs/recordings.md
for stream in source.streams:
    print(f"{stream['topic']}: {stream['messages']} messages, {stream['rate_hz']:.0f} Hz, joined by {stream['rule']}")
print("left out:", source.skipped)  # the last image: no joints after it, and nothing is extrapolated
frame = source.load(source.ids[1])
elbow = float(frame.signals["joint_states/position"])
print(frame, f"elbow {elbow:.3f}", frame.provenance["unit_source"])
assert abs(elbow - 0.35) < 1e-12  # between 0.3 and 0.4
assert len(source) == 9
