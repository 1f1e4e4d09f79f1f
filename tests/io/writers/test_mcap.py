"""MCAP recordings as ROS tools see them: read by rosbags alone."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("rosbags")
from rosbags.highlevel import AnyReader

from pcdata import open_source
from pcdata.errors import CaptureError, ConfigError
from pcdata.geometry import rigid, rotations
from pcdata.io import convert
from pcdata.structures import Episode, Signal
from tests.io.writers.made_captures import MadeCaptures, cut_to_episodes, made_captures, made_frame


def messages(folder: Path) -> dict[str, list[tuple[int, Any]]]:
    """All messages of one recording, by topic, with their times."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([folder]) as reader:
        for connection, time, raw in reader.messages():
            found.setdefault(connection.topic, []).append((time, reader.deserialize(raw, connection.msgtype)))
    return found


def image(message: Any, dtype: Any) -> np.ndarray:
    return message.data.view(dtype).reshape(message.height, message.width, -1)


def test_depth_is_metres_as_ros_tools_expect_it_bit_for_bit(tmp_path: Path) -> None:
    made = cut_to_episodes(made_captures())
    convert(made, "mcap", tmp_path / "out")
    sent = messages(tmp_path / "out" / "pick 0.mcap")["/camera/depth/image_raw"]
    assert [message.encoding for _, message in sent] == ["32FC1"] * 2  # tenths of a millimetre are no 16UC1
    for name, (_, message) in zip(made.ids, sent):
        expected = made.load(name).depth[0].numpy()
        assert np.array_equal(image(message, "<f4")[..., 0], np.where(expected > 0, expected, np.nan), equal_nan=True)


def test_depth_of_whole_millimetres_is_16UC1(tmp_path: Path) -> None:
    units = torch.randint(300, 900, (1, 12, 16))
    frame = replace(made_frame(), depth=(units.double() * 0.001).float())
    convert(MadeCaptures({"000": frame}), "mcap", tmp_path / "out")
    ((_, message),) = messages(tmp_path / "out" / "made.mcap")["/camera/depth/image_raw"]
    assert message.encoding == "16UC1"
    assert np.array_equal(image(message, "<u2")[..., 0], units[0].numpy())


def test_cameras_have_their_intrinsics_lens_frame_and_place_in_the_tree(tmp_path: Path) -> None:
    frame = replace(made_frame(views=2), provenance={"cameras": ["left eye", "right"]})
    convert(MadeCaptures({"000": frame}), "mcap", tmp_path / "out")
    found = messages(tmp_path / "out" / "made.mcap")
    for view, own in enumerate(["left_eye", "right"]):
        ((_, info),) = found[f"/{own}/depth/camera_info"]
        assert info.distortion_model == "rational_polynomial"
        assert np.array_equal(info.d, frame.camera.distortion[view])
        assert np.array_equal(info.k.reshape(3, 3), frame.camera.intrinsics[view])
        ((_, tf),) = found["/tf"]
        seen = tf.transforms[view]
        assert (seen.header.frame_id, seen.child_frame_id) == ("base", info.header.frame_id) == (
            "base", f"{own}_optical_frame",
        )  # fmt: skip
        rotation, offset = seen.transform.rotation, seen.transform.translation
        pose = rigid.from_rotation_translation(
            rigid.rotation_from_quaternion(
                torch.tensor([rotation.x, rotation.y, rotation.z, rotation.w], dtype=torch.float64)
            ),
            torch.tensor([offset.x, offset.y, offset.z], dtype=torch.float64),
        )
        assert torch.allclose(pose, frame.world_from_camera[view], rtol=0, atol=1e-12)
        ((_, exact),) = found[f"/{own}/pose_matrix"]
        assert np.array_equal(exact.data.reshape(4, 4), frame.world_from_camera[view])


def test_a_camera_that_turns_has_quaternions_that_do_not_jump(tmp_path: Path) -> None:
    frames = {}
    for number in range(8):
        angle = torch.tensor([[0.0, 2.0 + 0.3 * number, 0.0], [0.0, 0.0, 2.0 - 0.3 * number]], dtype=torch.float64)
        poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
        poses[:, :3, :3] = rotations.rotation_from_quaternion(rotations.quaternion_from_rotation_vector(angle))
        frames[f"{number}"] = replace(made_frame(number, views=2), world_from_camera=poses)
    convert(MadeCaptures(frames), "mcap", tmp_path / "out")
    sent = [tf for _, tf in messages(tmp_path / "out" / "made.mcap")["/tf"]]
    turns = np.array(
        [[[getattr(one.transform.rotation, axis) for axis in "wxyz"] for one in tf.transforms] for tf in sent]
    )
    assert turns.shape == (8, 2, 4)
    assert turns[0, 0, 0] > 0 > turns[-1, 0, 0]
    assert np.linalg.norm(np.diff(turns, axis=0), axis=-1).max() < 0.16  # half the angle of a step


def test_color_is_raw_unless_jpeg_is_asked_for_and_then_the_loss_is_told(tmp_path: Path) -> None:
    made = MadeCaptures({"000": made_frame()})
    assert set(convert(made, "mcap", tmp_path / "raw").lost) == {"sensor"}
    ((_, raw),) = messages(tmp_path / "raw" / "made.mcap")["/camera/color/image_raw"]
    assert np.array_equal(image(raw, "u1"), made.load("000").colors[0])
    loss = convert(made, "mcap", tmp_path / "jpeg", color="jpeg").lost["color"]
    assert loss.levels > 0
    assert f"by {loss.levels} of 255 levels at most" in str(loss)
    ((_, packed),) = messages(tmp_path / "jpeg" / "made.mcap")["/camera/color/image_raw/compressed"]
    assert packed.format == "jpeg"
    assert set(convert(made, "mcap", tmp_path / "png", color="png").lost) == {"sensor"}


def test_signals_are_arrays_and_texts_and_what_they_are_is_told(tmp_path: Path) -> None:
    made = cut_to_episodes(made_captures())
    convert(made, "mcap", tmp_path / "out")
    found = messages(tmp_path / "out" / "pick 1.mcap")
    told = json.loads(found["/pcdata"][0][1].data)
    assert [message.data for _, message in found["/signals/task"]] == ["put the cube on the disc: µ"] * 2
    plan = found["/signals/plan"][0][1]
    assert [axis.size for axis in plan.layout.dim] == [3, 3]
    assert np.array_equal(plan.data.reshape(3, 3), made.signals("002")["plan"].values[0].double())
    assert told["signals"]["plan"] == {"name": "plan", "kind": "position", "frame": "base", "dtype": "float32"}
    assert (told["schema"], told["frame_id"], told["samples"]) == (1, "base", ["002", "003"])
    attributes = {"task": "place", "tries": 2}
    assert told["episodes"] == [{"id": "pick 1", "first": 0, "length": 2, "attributes": attributes}]


def test_only_whole_numbers_that_no_float64_holds_are_told_as_rounded(tmp_path: Path) -> None:
    small = {"u8": torch.tensor([[255]], dtype=torch.uint8), "u32": torch.tensor([[7]], dtype=torch.uint32)}
    for name, values in (
        ("exact", {**small, "count": torch.tensor([[1 << 53]])}),
        ("big", {"id": torch.tensor([[-(1 << 63)]])}),
    ):
        signals = {key: Signal(one, "invariant") for key, one in values.items()}
        made = MadeCaptures({"000": replace(made_frame(), recorded_signals=signals)})
        assert ("signals" in convert(made, "mcap", tmp_path / name).lost) == (name == "big")
    again = open_source(tmp_path / "exact").signals("000")
    assert {key: one.values.tolist() for key, one in again.items()} == {
        "u8": [[255]],
        "u32": [[7]],
        "count": [[1 << 53]],
    }
    assert [again[key].values.dtype for key in small] == [torch.uint8, torch.uint32]


def test_times_are_those_of_the_episode_on_the_clock_that_it_names(tmp_path: Path) -> None:
    start = 1_700_000_000_123_456_789
    made = made_captures(4)
    made.episodes = [Episode("a", 0, 3, [5.0, 5.0, 5.1], {"start_ns": start})]
    convert(made, "mcap", tmp_path / "out")
    sent = messages(tmp_path / "out" / "a.mcap")["/camera/depth/image_raw"]
    assert [time for time, _ in sent] == [start, start + 1, start + 100_000_000]
    stamps = [(message.header.stamp.sec, message.header.stamp.nanosec) for _, message in sent]
    assert stamps == [divmod(time, 10**9) for time, _ in sent]


def test_a_signal_of_two_kinds_and_topics_of_one_name_are_told_apart(tmp_path: Path) -> None:
    joints = Signal(torch.zeros(1, 2), "invariant")
    frame = replace(made_frame(), recorded_signals={"a b": joints, "a/b": joints, "µ": joints})
    convert(MadeCaptures({"000": frame}), "mcap", tmp_path / "out")
    told = json.loads(messages(tmp_path / "out" / "made.mcap")["/pcdata"][0][1].data)["signals"]
    assert {topic: one["name"] for topic, one in told.items()} == {"a_b": "a b", "a_b_2": "a/b", "signal": "µ"}
    other = replace(
        frame, recorded_signals={**frame.recorded_signals, "a b": Signal(torch.zeros(1, 3), "position", "base")}
    )
    with pytest.raises(CaptureError, match="one kind, frame and type of each"):
        convert(MadeCaptures({"000": frame, "001": other}), "mcap", tmp_path / "mixed")


@pytest.mark.parametrize("options", [{"color": "video"}, {"quality": 0}, {"compression": "lz4"}])
def test_options_of_no_meaning_are_refused(options: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=f"mcap: {next(iter(options))} must be"):
        convert(made_captures(), "mcap", tmp_path / "out", **options)
