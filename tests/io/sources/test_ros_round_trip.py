"""What was written as a recording is read as what it was."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image as Picture
from scipy.spatial.transform import Rotation

from pcdata import open_source
from pcdata.io import SubsetSource, convert
from pcdata.synthetic import TeleopSource
from tests.ros_recordings import EPOCH, Entry, Types, packed_depth, written

STEP = 33_333_333


def test_a_simulated_set_written_as_recordings_comes_back_bit_for_bit(tmp_path: Path) -> None:
    whole = TeleopSource(num_episodes=2, num_views=2, size=(12, 16))
    starts = [one.first for one in whole.episodes]
    source = SubsetSource(whole, [whole.ids[start + step] for start in starts for step in range(3)])
    convert(source, "mcap", tmp_path / "out")
    again = open_source(tmp_path / "out")
    assert (again.ids, again.unread(), again.skipped) == (list(source.ids), [], {})
    for one, other in zip(source.episodes, again.episodes, strict=True):
        assert (one.id, one.first, one.length) == (other.id, other.first, other.length)
        assert other.times == pytest.approx([time - one.times[0] for time in one.times], abs=1e-9)
        assert dict(one.attributes).items() <= dict(other.attributes).items()
    for name in (source.ids[0], source.ids[-1]):
        one, other = source.load(name), again.load(name)
        for role in ("depth", "colors", "labels", "world_from_camera"):
            assert torch.equal(getattr(one, role), getattr(other, role)), role
        assert torch.equal(one.camera.intrinsics, other.camera.intrinsics)
        assert one.recorded_signals.keys() == other.recorded_signals.keys() > {"action"}
        assert all(one.recorded_signals[key].same_bits(other.recorded_signals[key]) for key in one.recorded_signals)


@pytest.mark.parametrize("form", ["db3", "mcap"])
def test_a_real_sequence_written_by_rosbags_is_read_back_with_its_times_gaps_and_drops(
    tmp_path: Path, test_data: Path, form: str
) -> None:
    make = Types(2)
    source = open_source(test_data / "seven_scenes", limit=4)
    frames = [source.load(name) for name in source.ids]
    height, width = frames[0].size
    k = frames[0].camera.intrinsics[0].reshape(-1).tolist()
    entries: list[Entry] = []
    jpegs: list[np.ndarray] = []
    for number, frame in enumerate(frames):
        stamp = EPOCH + number * STEP
        units = (frame.depth[0].double() * 1000).round().numpy().astype(np.uint16)
        form_of = "16UC1; compressedDepth png"
        packed = make.packed(stamp, packed_depth(units), form_of)
        entries.append(("/camera/depth/image_raw/compressedDepth", stamp + 9_000_000, packed))
        entries.append(("/camera/depth/camera_info", stamp, make.camera_info(stamp, size=(height, width), k=k)))
        content = io.BytesIO()
        Picture.fromarray(frame.colors[0].numpy()).save(content, "JPEG", quality=95)
        jpegs.append(np.asarray(Picture.open(io.BytesIO(content.getvalue()))))
        if number != 2:  # this color image was dropped
            color = make.packed(stamp + 2_000_000, content.getvalue(), "rgb8; jpeg compressed bgr8")
            entries.append(("/camera/color/image_raw/compressed", stamp + 7_000_000, color))
        pose = frame.world_from_camera[0].numpy()
        entries.append(("/tf", stamp, make.transform(stamp, "world", "camera_optical", pose[:3, 3], quaternion(pose))))
    for number in range(-1, 12):
        if number not in (9, 10, 11):  # joints end before the last depth image
            stamp = EPOCH + number * 10_000_000
            entries.append(("/joint_states", stamp, make.joints(stamp, one=0.5 * number, two=-0.25 * number)))
    path = written(tmp_path / ("take" if form == "db3" else "take.mcap"), entries, make, form=form)
    again = open_source(path, frame_id="world", max_time_apart=0.02)
    assert again.ids == ["000000", "000001"]
    assert again.skipped == {
        "000002": "no color image of /camera/color/image_raw/compressed within 0.02 s, the nearest is 0.0313 s off",
        "000003": "no value of /joint_states before and after it",
    }
    for number, sample_id in enumerate(again.ids):
        frame = again.load(sample_id)
        assert torch.equal(frame.depth, frames[number].depth)
        assert np.array_equal(frame.colors[0].numpy(), jpegs[number])
        pose = frames[number].world_from_camera[0].numpy()  # its rotation is one to some digits
        expected = Rotation.from_quat(quaternion(pose)).as_matrix()
        assert np.allclose(frame.world_from_camera[0, :3, :3].numpy(), expected, rtol=0, atol=1e-12)
        assert np.array_equal(frame.world_from_camera[0, :3, 3].numpy(), pose[:3, 3])
        place = number * STEP / 10_000_000
        joints = torch.tensor([[0.5 * place, -0.25 * place]]).double()
        assert torch.allclose(frame.signals["joint_states/position"], joints, atol=1e-12)
        assert frame.provenance["color_seconds_later"] == 0.002
    counts = {one["role"]: (one["dropped"], one["doubled"], one["missing"]) for one in again.streams[1:]}
    assert counts == {"color": (0, 0, 1), "signal joint_states/position": (5, 0, 1), "pose": (0, 0, 0)}
    assert len(open_source(path, frame_id="world", signals={"joint_states": None})) == 4  # at the default 0.034 s


def quaternion(pose: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(pose[:3, :3]).as_quat()
