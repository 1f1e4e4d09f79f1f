"""Times that cannot be what they seem are refused, with a way out that leads to the right ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pcdata import open_source
from pcdata.errors import CaptureError, IntrinsicsError
from tests.ros_recordings import EPOCH, STEP, Entry, Types, color_of, depth_of, written

HOUR = 3600 * 10**9


def depths(make: Types, stamps: list[int], encoding: str = "16UC1", **camera: Any) -> list[Entry]:
    """Depth images that were recorded one after another, whatever their headers say."""
    found: list[Entry] = []
    for number, stamp in enumerate(stamps):
        recorded = EPOCH + number * STEP
        pixels = color_of(number) if encoding == "rgb8" else depth_of(number)
        found.append(("/cam/depth/image_raw", recorded, make.image(stamp, pixels, encoding)))
        found.append(("/cam/depth/camera_info", recorded, make.camera_info(stamp, **camera)))
    return found


STAMPS = [EPOCH + number * STEP for number in range(4)]


def test_headers_of_which_some_hold_no_time_are_refused_and_read_by_the_recorder_s(tmp_path: Path) -> None:
    make = Types(2)
    path = written(tmp_path / "a.mcap", depths(make, [0, STAMPS[1], 0, STAMPS[3]]), make)
    with pytest.raises(CaptureError, match="of 2 of its 4 messages hold no time"):
        open_source(path)
    assert open_source(path, clock="recorded").episodes[0].times == pytest.approx([0, 1 / 30, 2 / 30, 0.1], abs=1e-6)


def test_a_simulator_s_clock_begins_at_zero(tmp_path: Path) -> None:
    make = Types(2)
    path = written(tmp_path / "a.mcap", depths(make, [number * STEP for number in range(3)]), make)
    assert open_source(path).episodes[0].times == pytest.approx([0, 1 / 30, 2 / 30], abs=1e-6)


def test_a_camera_that_never_changes_needs_no_time(tmp_path: Path) -> None:
    make = Types(2)
    entries = [
        (topic, time, make.camera_info(0) if "info" in topic else message)
        for topic, time, message in depths(make, STAMPS)
    ]
    assert len(open_source(written(tmp_path / "a.mcap", entries, make))) == 4


def test_messages_without_header_on_another_clock_are_refused_and_joined_by_the_recorder_s(tmp_path: Path) -> None:
    make = Types(2)
    entries = depths(make, [stamp + HOUR for stamp in STAMPS])
    entries += [("/command", EPOCH - 1 + number * STEP, make.numbers([number])) for number in range(4)]
    path = written(tmp_path / "a.mcap", entries, make)
    options: dict[str, Any] = {"signals": {"command": {"kind": "invariant"}}}
    with pytest.raises(CaptureError, match=r"3\.6e\+03 s after that: two clocks; clock='recorded'"):
        open_source(path, **options)
    source = open_source(path, clock="recorded", **options)
    assert [float(source.signals(name)["command"].values) for name in source.ids] == [0, 1, 2, 3]


def test_joints_on_another_clock_are_named_and_joined_by_the_recorder_s(tmp_path: Path) -> None:
    make = Types(2)
    entries = depths(make, STAMPS)
    for number in range(-1, 6):
        time = EPOCH + number * STEP
        entries.append(("/joint_states", time, make.joints(time + HOUR, a=float(number))))
    path = written(tmp_path / "a.mcap", entries, make)
    with pytest.raises(
        CaptureError, match=r"joint_states are 3\.6e\+03 s ahead of those of /cam/depth.*clock='recorded'"
    ):
        open_source(path)
    with pytest.raises(CaptureError, match=r"its times begin 3\.6e\+03 s after the last depth image.*clock='recorded'"):
        open_source(path, clock="header")
    source = open_source(path, clock="recorded")
    assert [float(source.signals(name)["joint_states/position"].values) for name in source.ids] == [0, 1, 2, 3]
    assert len(open_source(path, signals={"joint_states/position": None})) == 4


@pytest.mark.parametrize("stream", ["color", "joints", "tf"])
def test_streams_on_another_clock_are_refused_where_they_would_meet_images_of_another_moment(
    stream: str, tmp_path: Path
) -> None:
    make, entries, second = Types(2), list[Entry](), 10**9
    for number in range(8):
        time = EPOCH + number * second
        off = time + 3 * second  # the clock of one stream is three images ahead
        entries += [
            ("/cam/depth/image_raw", time + 1, make.image(time, depth_of(number), "16UC1")),
            ("/cam/depth/camera_info", time + 1, make.camera_info(time)),
            (
                "/cam/color/image_raw",
                time + 1,
                make.image(off if stream == "color" else time, color_of(number), "rgb8"),
            ),
            ("/joint_states", time + 1, make.joints(off if stream == "joints" else time, a=float(number))),
            (
                "/tf",
                time + 1,
                make.transform(off if stream == "tf" else time, "base", "camera_optical", (number, 0, 0)),
            ),
        ]
    path = written(tmp_path / "a.mcap", entries, make)
    with pytest.raises(CaptureError, match=r"are 3 s ahead of those of /cam/depth/image_raw.*clock='recorded'"):
        open_source(path, frame_id="base")
    source = open_source(path, frame_id="base", clock="recorded")
    found = [source.load(name) for name in source.ids]
    assert [float(frame.signals["joint_states/position"]) for frame in found] == list(range(8))
    assert [float(frame.world_from_camera[0, 0, 3]) for frame in found] == list(range(8))
    assert [frame.provenance["color_seconds_later"] for frame in found] == [0] * 8
    assert len(open_source(path, frame_id="base", clock="header")) == 5  # as they stand


def test_a_clock_that_is_set_back_does_not_lay_one_run_into_another(tmp_path: Path) -> None:
    make = Types(2)
    path = written(tmp_path / "a.mcap", depths(make, [(number % 4 * 2 + 1) * 10**9 for number in range(8)]), make)
    with pytest.raises(CaptureError, match=r"go back by 6 s at message 4 of 8.*clock='recorded'"):
        open_source(path)
    assert open_source(path, clock="recorded").ids == [f"{number:06d}" for number in range(8)]
    assert len(open_source(path, clock="header")) == 8


def test_a_clock_that_stands_still_is_refused_and_images_of_one_time_are_told(tmp_path: Path) -> None:
    make = Types(2)
    still = written(tmp_path / "still.mcap", depths(make, [EPOCH] * 4), make)
    with pytest.raises(CaptureError, match=r"all 4 messages of /cam/depth/image_raw hold one time.*clock='recorded'"):
        open_source(still)
    assert len(open_source(still, clock="recorded")) == 4
    twice = written(tmp_path / "twice.mcap", depths(make, [STAMPS[0], STAMPS[1], STAMPS[1], STAMPS[3]]), make)
    assert "depth /cam/depth/image_raw: 1 of 4 images have the time of another" in open_source(twice).unread()


def test_tf_is_on_the_clock_that_is_asked_for(tmp_path: Path) -> None:
    make = Types(2)
    entries = depths(make, STAMPS)
    for number in range(4):
        time = EPOCH + number * STEP
        entries.append(("/tf", time, make.transform(time - HOUR, "base", "camera_optical", (number, 0, 0))))
    path = written(tmp_path / "a.mcap", entries, make)
    source = open_source(path, clock="recorded", frame_id="base")
    assert [float(source.load(name).world_from_camera[0, 0, 3]) for name in source.ids] == [0, 1, 2, 3]


def test_frames_in_a_circle_are_refused_and_a_frame_in_itself_is_passed_over(tmp_path: Path) -> None:
    make = Types(2)
    edges = [("a", "b"), ("b", "camera_optical"), ("camera_optical", "a")]
    for name, pairs in (("loop", edges), ("self", [("a", "a"), ("a", "camera_optical")])):
        entries = depths(make, STAMPS)
        entries += [("/tf_static", EPOCH, make.transform(0, *pair, (0, 0, 1))) for pair in pairs]
        written(tmp_path / f"{name}.mcap", entries, make)
    with pytest.raises(CaptureError, match="tf goes in a circle"):
        open_source(tmp_path / "loop.mcap", frame_id="a")
    assert len(open_source(tmp_path / "self.mcap", frame_id="a")) == 4


def test_a_joint_that_is_named_twice_is_told_and_not_read(tmp_path: Path) -> None:
    make = Types(2)
    joints = make.joints(EPOCH, a=1.0, b=2.0)
    joints.name = ["a", "a"]
    source = open_source(written(tmp_path / "a.mcap", [*depths(make, STAMPS), ("/joint_states", EPOCH, joints)], make))
    assert not source.signals(source.ids[0])
    assert "/joint_states: its messages name the joint 'a' twice" in source.unread()


@pytest.mark.parametrize("wrong", [{"k": [float("nan")] * 9}, {"size": (0, 0)}, {"k": [0.0] * 9}])
def test_a_camera_that_is_not_calibrated_is_told_by_the_option(tmp_path: Path, wrong: dict[str, Any]) -> None:
    make = Types(2)
    path = written(tmp_path / "a.mcap", depths(make, STAMPS[:1], **wrong), make)
    with pytest.raises(IntrinsicsError, match="--intrinsics FX FY CX CY"):
        open_source(path)
    assert len(open_source(path, intrinsics=(20.0, 20.0, 8.0, 6.0))) == 1


def test_a_picture_in_colors_is_no_depth_whatever_unit_is_stated(tmp_path: Path) -> None:
    make = Types(2)
    path = written(tmp_path / "a.mcap", depths(make, STAMPS[:1], encoding="rgb8"), make)
    with pytest.raises(CaptureError, match="'rgb8', which is not read as depth"):
        open_source(path, depth="/cam/depth/image_raw")
