"""The code on the page about live pipelines runs, with cameras that are not there."""

from __future__ import annotations

import re
import sys
import threading
import types
from pathlib import Path

import numpy as np
import pytest

import pcdata
from pcdata.live import Fault
from pcdata.synthetic import tabletop

PAGE = (Path(__file__).parents[2] / "docs" / "live.md").read_text(encoding="utf-8")
BLOCKS = {
    re.match(r"# ([\w ]+)", block)[1]: block
    for block in re.findall(r"^```python\n(.*?)^```$", PAGE, flags=re.MULTILINE | re.DOTALL)
}
SCENE = tabletop(2, noise="stereo", num_views=1, size=(60, 80))
NUMBER = 6
K = SCENE.frame.camera.intrinsics[0].numpy()


def images(number):
    frame = SCENE.render(seed_noise=number)
    return np.rint(frame.depth[0].numpy() * 1000).astype(np.uint16), frame.colors[0].numpy().copy()


def expected(number):
    depth, colors = images(number)
    chain = pcdata.load_config("policy.yaml").pipeline.split()[0]
    return chain(pcdata.DepthFrame.from_numpy(depth, K, metres_per_unit=0.001, colors=colors))


@pytest.fixture
def policy(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    steps = [
        pcdata.Deproject(),
        pcdata.CropWorkspace(frame="camera", lower=(-1, -1, 0.1), upper=(1, 1, 3)),
        pcdata.FarthestPointSample(num_points=32),
    ]
    Path("chain.yaml").write_text(pcdata.Compose(steps).to_yaml())
    steps.append(pcdata.RandomJitter(sigma=0.001))
    Path("policy.yaml").write_text(pcdata.Compose(steps).to_yaml())


def module(monkeypatch, name, **contents):
    made = types.ModuleType(name)
    vars(made).update(contents)
    monkeypatch.setitem(sys.modules, name, made)


def assert_clouds(clouds, possible):
    wanted = [expected(number).points.numpy() for number in possible]
    assert clouds
    for cloud in clouds:
        assert any(np.array_equal(cloud.points.numpy(), points) for points in wanted)


class Data:
    def __init__(self, array):
        self.array = array

    def get_data(self):
        return self.array


class FakeRealSense:
    """What the page uses of pyrealsense2: a device of its own memory, which it uses again for every frame."""

    def __init__(self):
        self.number = 0
        self.room = [array.copy() for array in images(0)]
        self.taken = threading.Event()

    def start(self, streams):
        assert streams.asked == [("depth", 848, 480, "z16", 60), ("color", 848, 480, "rgb8", 60)]
        return self

    def get_device(self):
        return types.SimpleNamespace(first_depth_sensor=lambda: types.SimpleNamespace(get_depth_scale=lambda: 0.001))

    def get_stream(self, stream):
        assert stream == "color"
        lens = types.SimpleNamespace(fx=float(K[0, 0]), fy=float(K[1, 1]), ppx=float(K[0, 2]), ppy=float(K[1, 2]))
        return types.SimpleNamespace(as_video_stream_profile=lambda: types.SimpleNamespace(get_intrinsics=lambda: lens))

    def wait_for_frames(self):
        if self.number > 1:
            self.taken.wait(5)  # a camera that is slower than the pipeline
            self.taken.clear()
        if self.number == NUMBER:
            raise StopIteration
        for room, array in zip(self.room, images(self.number)):
            room[:] = array
        self.number += 1
        return types.SimpleNamespace(
            get_depth_frame=lambda: Data(self.room[0]), get_color_frame=lambda: Data(self.room[1])
        )


class FakeStreams:
    def __init__(self):
        self.asked = []

    def enable_stream(self, *asked):
        self.asked.append(asked)


def test_the_lines_for_realsense_run(policy, monkeypatch, capsys):
    device = FakeRealSense()
    module(
        monkeypatch,
        "pyrealsense2",
        pipeline=lambda: device,
        align=lambda stream: types.SimpleNamespace(process=lambda frames: frames),
        config=FakeStreams,
        stream=types.SimpleNamespace(depth="depth", color="color"),
        format=types.SimpleNamespace(z16="z16", rgb8="rgb8"),
    )
    clouds = []

    def act(cloud):
        clouds.append(cloud)
        device.taken.set()

    exec(compile(BLOCKS["RealSense"], "docs/live.md", "exec"), {"act": act})
    assert_clouds(clouds, range(1, NUMBER))
    assert len(clouds) == NUMBER - 1
    assert "faults: none" in capsys.readouterr().out


def test_the_lines_for_ros_run(policy, monkeypatch):
    seen, ready, clouds = {}, threading.Event(), []
    now = types.SimpleNamespace(nanoseconds=int(50e9))
    node = types.SimpleNamespace(get_clock=lambda: types.SimpleNamespace(now=lambda: now))

    class Synchronizer:
        def __init__(self, subscribers, queue, slop):
            assert [topic for _, _, topic in subscribers] == [
                "/camera/aligned_depth_to_color/image_raw",
                "/camera/color/image_raw",
                "/camera/color/camera_info",
            ]

        def registerCallback(self, put):
            seen["put"] = put
            ready.set()

    def message(array, number):
        stamp = types.SimpleNamespace(sec=50, nanosec=1_000_000 * number)
        height, width = array.shape[:2]
        header = types.SimpleNamespace(stamp=stamp)
        return types.SimpleNamespace(data=array.tobytes(), height=height, width=width, header=header)

    taken = threading.Event()

    def spin(_):
        assert ready.wait(5)
        for number in range(NUMBER):
            depth, colors = images(number)
            seen["put"](message(depth, number), message(colors, number), types.SimpleNamespace(k=K.flatten().tolist()))
            if number:
                taken.wait(5)
                taken.clear()
            else:
                while newest()._held is not None:
                    pass
        newest().close()

    def newest():
        return space["newest"]

    def act(cloud):
        clouds.append(cloud)
        taken.set()

    module(monkeypatch, "rclpy", init=lambda: None, create_node=lambda name: node, spin=spin)
    module(
        monkeypatch,
        "message_filters",
        ApproximateTimeSynchronizer=Synchronizer,
        Subscriber=lambda node, kind, topic: (node, kind, topic),
    )
    module(monkeypatch, "sensor_msgs")
    module(monkeypatch, "sensor_msgs.msg", Image="image", CameraInfo="info")
    space = {"act": act}
    exec(compile(BLOCKS["ROS 2"], "docs/live.md", "exec"), space)
    assert_clouds(clouds, range(1, NUMBER))
    assert len(clouds) == NUMBER - 1
    assert space["live"].stats().faults == {}


def test_the_lines_for_arrays_run(policy):
    space = {"depth": images(0)[0], "next_depth": images(1)[0], "intrinsics": K}
    exec(compile(BLOCKS["numpy"], "docs/live.md", "exec"), space)
    assert space["answer"].cloud.num_points == 32


def test_the_page_tells_every_fault():
    rows = set(re.findall(r"`(\w+)`", "".join(re.findall(r"^\| (`.*?) \|", PAGE, flags=re.MULTILINE))))
    assert rows == {str(fault) for fault in Fault}
