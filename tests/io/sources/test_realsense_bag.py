"""RealSense recordings: depth in the recorded unit, color registered by the recorded transform."""

from __future__ import annotations

import pickle
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import torch

from pcdata import DepthFrame, open_source
from pcdata.errors import CaptureError, ConfigError, IntrinsicsError, PoseError, UnitError
from pcdata.geometry import rigid
from tests.recordings import COLOR, DEPTH, MILLISECOND, SHIFT, SIZE, camera_info, image, recording, written


def without(topic: str) -> list[tuple[str, int, object]]:
    return [entry for entry in recording() if entry[0] != topic]


def with_other(topic: str, *others: object) -> list[tuple[str, int, object]]:
    return without(topic) + [(topic, 100 * MILLISECOND + number, message) for number, message in enumerate(others)]


def load_all(path: Path) -> list[DepthFrame]:
    source = open_source(path)
    return [source.load(name) for name in source.ids]


def test_depth_comes_in_order_in_the_recorded_unit_with_its_camera(tmp_path):
    source = open_source(written(tmp_path / "a.bag", recording()))
    assert source.kind == "realsense_bag"
    assert source.ids == ["000000", "000001", "000002"]
    for number, name in enumerate(source.ids):
        frame = source.load(name)
        assert frame.colors is None
        assert torch.equal(frame.depth[0, :2], torch.zeros(2, SIZE[1]))
        assert torch.allclose(frame.depth[0, 2:], torch.tensor(1.0 + 0.05 * number), atol=1e-6)
        assert frame.camera.intrinsics[0, 0, 0] == 30.0
        assert frame.capture_index == number
        assert frame.provenance["metres_per_unit"] == 0.00025
        assert frame.provenance["sensor_name"] == "Intel RealSense D435"
        assert frame.provenance["timestamps"] == [pytest.approx(0.1 + 0.033 * number)]


def test_registered_depth_lies_on_the_color_image_nearest_in_time(tmp_path):
    path = written(tmp_path / "a.bag", recording())
    source = open_source(path, registered=True, max_time_apart=0.01)
    assert source.ids == ["000000", "000001"]
    left = set(open_source(path).ids) - set(source.ids)
    assert left == set(source.skipped), "none is left out without a word"
    assert all("no color image within 0.01 s, the nearest is" in why for why in source.skipped.values())
    frame = source.load("000001")
    assert int(frame.colors[0, 0, 0, 1]) == 50
    assert frame.provenance["color_seconds_later"] == pytest.approx(0.005)
    # A point that both see has moved by f * shift / z to the right in the color image.
    assert torch.equal(
        torch.tensor(frame.provenance["registered"]["color_from_depth"])[0, :3, 3], torch.tensor([SHIFT, 0, 0])
    )
    readings = (frame.depth[0] > 0).any(dim=0).nonzero().squeeze(1)
    assert int(readings[0]) == round(30.0 * SHIFT / 1.05)
    assert torch.allclose(frame.depth[frame.depth > 0], torch.tensor(1.05), atol=1e-6)


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8"])
def test_every_order_of_channels_and_padded_rows_are_read_as_rgb(tmp_path, encoding):
    rgb = np.arange(SIZE[0] * SIZE[1] * 3, dtype=np.uint64).astype(np.uint8).reshape(*SIZE, 3)
    channels = {"r": rgb[..., 0], "g": rgb[..., 1], "b": rgb[..., 2], "a": np.full(SIZE, 7, np.uint8)}
    pixels = np.stack([channels[letter] for letter in encoding[:-1]], axis=-1)
    path = written(tmp_path / "a.bag", with_other(f"{COLOR}/image/data", image(pixels, encoding, pad=5)))
    frame = open_source(path, registered=True).load("000000")
    assert np.array_equal(frame.colors[0].numpy(), rgb)


def test_big_endian_depth_means_the_same(tmp_path):
    units = np.full(SIZE, 4000, ">u2")
    path = written(tmp_path / "a.bag", with_other(f"{DEPTH}/image/data", image(units, "16UC1")))
    assert torch.equal(open_source(path).load("000000").depth, torch.ones(1, *SIZE))


def test_images_recorded_in_one_nanosecond_stay_apart(tmp_path):
    images = [(f"{DEPTH}/image/data", 5, image(np.full(SIZE, units, np.uint16), "mono16")) for units in (4000, 8000)]
    path = written(tmp_path / "a.bag", without(f"{DEPTH}/image/data") + images)
    source = open_source(path)
    assert [float(source.load(name).depth.max()) for name in source.ids] == [1.0, 2.0]


def test_a_source_can_be_sent_to_a_worker(tmp_path):
    source = open_source(written(tmp_path / "a.bag", recording()), registered=True)
    again = pickle.loads(pickle.dumps(source))
    assert torch.equal(again.load("000000").depth, source.load("000000").depth)


def test_what_a_recording_lacks_is_named(tmp_path):
    cases = {
        f"{DEPTH}/image/data": (CaptureError, "one Depth stream, found 0"),
        "/device_0/sensor_0/option/Depth Units/value": (UnitError, "does not state its depth unit"),
        f"{DEPTH}/info/camera_info": (CaptureError, "camera_info has 0 messages"),
        f"{DEPTH}/tf/0": (CaptureError, "tf/0 has 0 messages"),
    }
    for number, (topic, (error, words)) in enumerate(cases.items()):
        with pytest.raises(error, match=words):
            open_source(written(tmp_path / f"{number}.bag", without(topic)))
    path = written(tmp_path / "gray.bag", without(f"{COLOR}/image/data"))
    assert len(open_source(path)) == 3
    with pytest.raises(CaptureError, match="one Color stream, found 0"):
        open_source(path, registered=True)


def test_color_too_late_for_every_depth_is_refused_with_the_gap(tmp_path):
    path = written(tmp_path / "a.bag", recording())
    with pytest.raises(CaptureError, match=r"within 0.001 s; the nearest is 0.005 s off"):
        open_source(path, registered=True, max_time_apart=0.001)
    with pytest.raises(ConfigError, match="positive seconds"):
        open_source(path, registered=True, max_time_apart=0.0)


def test_the_lens_models_of_the_sdk_are_read(tmp_path):
    topic = f"{DEPTH}/info/camera_info"
    lens = (0.1, -0.2, 0.001, 0.002, 0.0)
    forward = written(tmp_path / "forward.bag", with_other(topic, camera_info(30.0, lens)))
    assert open_source(forward).load("000000").camera.distortion.tolist() == [list(lens)]
    fisheye = (0.1, -0.02, 0.001, 0.002, 0.0)  # the SDK writes five numbers of every model
    for said, numbers, model, count in (
        ("Inverse Brown Conrady", lens, "inverse_brown_conrady", 5),
        ("Kannala Brandt4", fisheye, "fisheye", 4),
        ("Ftheta", (0.9, 0.0, 0.0, 0.0, 0.0), "f_theta", 1),
    ):
        path = written(tmp_path / f"{model}.bag", with_other(topic, camera_info(30.0, numbers, said)))
        assert open_source(path).load("000000").camera.lenses == [(model, list(numbers[:count]))]
    unknown = with_other(topic, camera_info(30.0, lens, "Panini"))
    with pytest.raises(IntrinsicsError, match=r"Panini.*undistort"):
        open_source(written(tmp_path / "unknown.bag", unknown))


def test_images_that_cannot_be_right_are_refused(tmp_path):
    units = np.full(SIZE, 4000, np.uint16)
    short = image(units, "mono16")
    short.data = short.data[:-2]
    huge = image(units, "mono16")
    huge.height = huge.width = 1 << 20
    bad = {"coded": image(units.view(np.uint8), "8UC1"), "short": short, "huge": huge}
    words = {
        "coded": "16UC1, mono16 or 32FC1, not '8UC1'",
        "short": "it is damaged",
        "huge": "an image must have 1 .. ",
    }
    for name, message in bad.items():
        source = open_source(written(tmp_path / f"{name}.bag", with_other(f"{DEPTH}/image/data", message)))
        with pytest.raises(CaptureError, match=words[name]):
            source.load("000000")


def test_a_bag_without_its_index_is_read_through_and_says_so(tmp_path):
    whole = written(tmp_path / "a.bag", recording())
    cut = tmp_path / "cut.bag"
    cut.write_bytes(whole.read_bytes()[:-100])
    assert all(torch.equal(one.depth, other.depth) for one, other in zip(load_all(cut), load_all(whole), strict=True))
    assert open_source(cut).unread()[0].startswith("cut.bag: its index cannot be read")


@pytest.mark.parametrize("keep", [13, 200, 5000])
def test_a_bag_that_ends_early_is_a_capture_error(tmp_path, keep):
    whole = written(tmp_path / "a.bag", recording()).read_bytes()
    (tmp_path / "cut.bag").write_bytes(whole[:keep])
    with pytest.raises(CaptureError, match=r"cut\.bag"):
        load_all(tmp_path / "cut.bag")


@pytest.mark.parametrize("seed", range(20))
def test_damage_anywhere_is_an_error_of_the_capture_or_changes_readings_only(tmp_path, seed):
    data = bytearray(written(tmp_path / "a.bag", recording()).read_bytes())
    places = np.random.default_rng(seed).integers(13, len(data), 30)
    for place in places:
        data[place] ^= 0xFF
    (tmp_path / "bad.bag").write_bytes(bytes(data))
    with suppress(CaptureError, UnitError, PoseError):
        for frame in load_all(tmp_path / "bad.bag"):
            assert frame.depth.shape[1:] == frame.camera.size


def test_the_real_recording_has_the_documented_facts(test_data):
    path = test_data / "realsense_bag" / "single_depth_color_640x480.bag"
    source = open_source(path)
    assert source.ids == ["000000", "000001"]
    frame = source.load("000001")
    assert frame.camera.size == (480, 640)
    assert frame.provenance["metres_per_unit"] == 0.001
    assert 0.5 < float((frame.depth > 0).float().mean()) < 1.0
    with pytest.raises(CaptureError, match=r"the nearest is 0.0544 s off"):
        open_source(path, registered=True)
    seen = open_source(path, registered=True, max_time_apart=0.06).load("000000")
    assert seen.camera.intrinsics[0, 0, 0] == pytest.approx(613.2, abs=0.1)
    pose = torch.tensor(seen.provenance["registered"]["color_from_depth"])[0].double()
    rigid.check_rigid("the recorded transform", pose)
    assert float(pose[:3, 3].norm()) == pytest.approx(0.0143, abs=1e-3)


def test_a_folder_with_one_recording_is_that_recording(tmp_path):
    (tmp_path / "take").mkdir()
    written(tmp_path / "take" / "a.bag", recording())
    for kind in (None, "realsense_bag"):
        source = open_source(tmp_path / "take", kind=kind)
        assert source.ids == ["000000", "000001", "000002"]
        assert source.load("000001").provenance["files"] == {"bag": "a.bag"}
    written(tmp_path / "take" / "b.bag", recording())
    with pytest.raises(CaptureError, match=r"holds 2 recordings, a\.bag, b\.bag; give the path of one"):
        open_source(tmp_path / "take")


def test_the_color_stream_that_is_not_read_is_told_with_the_way_to_read_it(tmp_path):
    path = written(tmp_path / "a.bag", recording())
    (line,) = open_source(path).unread()
    assert line == f"color stream {COLOR}/image/data (2 messages); registered=True (--registered) reads it"
    assert open_source(path, registered=True).unread() == []
