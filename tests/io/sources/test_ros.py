"""Recordings of robots: the same messages in every container, joined on the clock of the depth."""

from __future__ import annotations

import itertools
import pickle
import struct
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pcdata import open_source
from pcdata.build import build_dataset, config_from_yaml
from pcdata.errors import CaptureError, ConfigError, FrameError, IntrinsicsError, PcdataError, UnitError
from pcdata.files.recent import Recent
from pcdata.geometry import rigid
from pcdata.io import refused_captures
from pcdata.io.messages import bag_file, chunked_file, mcap_file
from pcdata.io.store.manifest import Manifest
from tests.ros_recordings import (
    EPOCH,
    SIZE,
    STEP,
    Entry,
    Types,
    color_of,
    depth_of,
    packed_depth,
    packed_rvl,
    png,
    recording,
    written,
)

rosbag1 = pytest.importorskip("rosbags.rosbag1")
storage_mcap = pytest.importorskip("rosbags.rosbag2.storage_mcap")

FORMS = [("bag", False), ("bag", True), ("mcap", False), ("mcap", True), ("db3", False), ("folder", False)]
ROS2 = Types(2)
DEPTH, COLOR = "/cam/depth/image_raw", "/cam/color/image_raw"


def mcap(folder: Path, entries: list[Entry], name: str = "a") -> Path:
    return written(folder / f"{name}.mcap", entries, ROS2)


def without(*topics: str) -> list[Entry]:
    return [entry for entry in recording(ROS2) if entry[0] not in topics]


def with_depth(make_image: Any) -> list[Entry]:
    """The recording with other depth images, made of their number and stamp."""
    stamps = [EPOCH + number * STEP for number in range(4)]
    return without(DEPTH, COLOR) + [(DEPTH, stamp, make_image(number, stamp)) for number, stamp in enumerate(stamps)]


def metres(units: np.ndarray) -> torch.Tensor:
    return torch.from_numpy((units.astype(np.float64) * 0.001).astype(np.float32))


@pytest.mark.parametrize(("form", "packed"), FORMS)
def test_every_container_gives_the_same(tmp_path: Path, form: str, packed: bool) -> None:
    make = Types(1 if form == "bag" else 2)
    name = f"take.{form}" if form in ("bag", "mcap") else "take"
    source = open_source(written(tmp_path / name, recording(make), make, form=form, packed=packed), frame_id="base")
    assert (source.kind, source.ids, source.skipped) == ("ros", ["000000", "000001", "000002", "000003"], {})
    for number, sample_id in enumerate(source.ids):
        frame = source.load(sample_id)
        assert torch.equal(frame.depth[0], metres(depth_of(number)))
        assert torch.equal(frame.colors[0], torch.from_numpy(color_of(number)))
        assert frame.provenance["stamp_ns"] == EPOCH + number * STEP
        assert frame.provenance["color_seconds_later"] == 0.005
        place = number * STEP / 10_000_000  # of joints and tf, at 100 Hz
        assert torch.allclose(
            frame.signals["joint_states/position"],
            torch.tensor([[1 - 0.002 * place, 0.001 * place]]).double(),
            atol=1e-12,
        )
        turn = rigid.rotation_about_axis(torch.tensor([0.0, 0, 1]).double(), torch.tensor(0.01 * place).double())
        expected = turn @ torch.tensor([0.0, 0.2, 0]).double() + torch.tensor([0.1 * place, 0, 0.5]).double()
        assert torch.allclose(frame.world_from_camera[0, :3, 3], expected, atol=1e-12)
        assert torch.allclose(frame.world_from_camera[0, :3, :3], turn, atol=1e-12)
    (episode,) = source.episodes
    assert (episode.id, episode.length, episode.attributes) == ("take", 4, {"start_ns": EPOCH})
    assert episode.times == pytest.approx([n * STEP / 1e9 for n in range(4)], abs=1e-12)
    joints = next(one for one in source.streams if one["role"] == "signal joint_states/position")
    assert {joints[word] for word in ("rate_hz", "messages", "interpolated", "missing")} == {100.0, 20, 3, 0}
    assert open_source(source.path).load("000000").world_from_camera is None


def test_a_loose_db3_and_a_loose_mcap_are_read_as_their_folder_is(tmp_path: Path) -> None:
    for form in ("db3", "folder"):
        folder = written(tmp_path / form / "take", recording(ROS2), ROS2, form=form)
        (file,) = (one for one in folder.iterdir() if one.suffix != ".yaml")
        assert torch.equal(open_source(file).load("000002").depth, open_source(folder).load("000002").depth)
        (folder / "metadata.yaml").unlink()
        assert open_source(folder).ids == open_source(file).ids


def test_a_folder_of_files_has_an_episode_for_each(tmp_path: Path) -> None:
    for name in ("take_10", "take_2"):
        mcap(tmp_path / "set", recording(ROS2, count=2), name)
    source = open_source(tmp_path / "set")
    assert source.ids == ["take_2/000000", "take_2/000001", "take_10/000000", "take_10/000001"]
    assert [(one.id, one.first, one.length) for one in source.episodes] == [("take_2", 0, 2), ("take_10", 2, 2)]
    assert torch.equal(source.load("take_10/000001").depth[0], metres(depth_of(1)))


# -- images ------------------------------------------------------------------------------------------------------------


def rvl_image(units: np.ndarray) -> bytes:
    return bytes(12) + struct.pack("<II", units.shape[1], units.shape[0]) + packed_rvl(units)


DEPTHS = {
    "padded rows": lambda n, t: ROS2.image(t, depth_of(n), "16UC1", pad=6),
    "big endian": lambda n, t: ROS2.image(t, depth_of(n).astype(">u2"), "16UC1"),
    "floats": lambda n, t: ROS2.image(t, metres(depth_of(n)).numpy(), "32FC1"),
    "big-endian floats": lambda n, t: ROS2.image(t, metres(depth_of(n)).numpy().astype(">f4"), "32FC1", pad=4),
    "packed": lambda n, t: ROS2.packed(t, packed_depth(depth_of(n)), "16UC1; compressedDepth png"),
    "packed without a name": lambda n, t: ROS2.packed(t, packed_depth(depth_of(n)), "16UC1; compressedDepth"),
    "RVL": lambda n, t: ROS2.packed(t, rvl_image(depth_of(n)), "16UC1; compressedDepth rvl"),
    "a PNG of 16 bits": lambda n, t: ROS2.packed(t, png(depth_of(n)), "16UC1; png compressed"),
}


@pytest.mark.parametrize("name", DEPTHS)
def test_depth_means_the_same_however_it_is_encoded(tmp_path: Path, name: str) -> None:
    frame = open_source(mcap(tmp_path, with_depth(DEPTHS[name]))).load("000003")
    assert torch.equal(frame.depth[0], metres(depth_of(3)))


def test_nan_and_infinite_floats_are_no_reading(tmp_path: Path) -> None:
    depth = np.full(SIZE, 0.8, np.float32)
    depth[0, :3] = np.nan, np.inf, -np.inf
    source = open_source(mcap(tmp_path, with_depth(lambda n, t: ROS2.image(t, depth, "32FC1"))))
    found = source.load("000000").depth[0]
    assert found[0, :3].tolist() == [0, 0, 0]
    assert torch.equal(found[1:], torch.from_numpy(depth[1:]))


def test_packed_floats_are_what_their_two_numbers_say(tmp_path: Path) -> None:
    a, b = 100.0 * 101.0, 1.0 - 100.0 * 101.0 / 10.0  # as the transport packs for 10 m
    depth = np.linspace(0.5, 3.0, SIZE[0] * SIZE[1]).reshape(SIZE)
    stored = (a / depth + b).astype(np.uint16)
    stored[0, 0] = 0
    form = "32FC1; compressedDepth png"
    path = mcap(tmp_path, with_depth(lambda n, t: ROS2.packed(t, packed_depth(stored, a, b), form)))
    found = open_source(path).load("000000").depth[0].numpy()
    assert found[0, 0] == 0
    assert np.abs(found - depth)[stored > 0].max() < (depth**2).max() / a * 1.01  # one step of the stored numbers


def test_sixteen_bits_are_millimetres_unless_something_else_is_said(tmp_path: Path) -> None:
    path = mcap(tmp_path, without())
    facts = open_source(path).load("000000").provenance
    assert (facts["metres_per_unit"], facts["unit_source"]) == (0.001, "REP 118: 16-bit depth is in millimetres")
    frame = open_source(path, metres_per_unit=0.0005).load("000000")
    assert frame.provenance["unit_source"] == "stated by metres_per_unit"
    assert torch.allclose(frame.depth[0], metres(depth_of(0)) / 2, atol=1e-6)
    unnamed = mcap(tmp_path, with_depth(lambda n, t: ROS2.image(t, depth_of(n), "mono16")), "b")
    with pytest.raises(UnitError, match="'mono16', which says nothing of a unit"):
        open_source(unnamed)
    assert torch.equal(open_source(unnamed, metres_per_unit=0.001).load("000000").depth[0], metres(depth_of(0)))


COLORS = {
    "bgr8": lambda rgb: rgb[..., ::-1],
    "rgba8": lambda rgb: np.dstack([rgb, np.zeros(SIZE, np.uint8)]),
    "bgra8": lambda rgb: np.dstack([rgb[..., ::-1], np.zeros(SIZE, np.uint8)]),
}


@pytest.mark.parametrize("encoding", COLORS)
def test_color_is_rgb_however_it_is_encoded(tmp_path: Path, encoding: str) -> None:
    pixels = COLORS[encoding](color_of(0))
    path = mcap(tmp_path, [*without(COLOR), (COLOR, EPOCH, ROS2.image(EPOCH, pixels, encoding, pad=3))])
    source = open_source(path)
    assert torch.equal(source.load("000000").colors[0], torch.from_numpy(color_of(0)))
    assert list(source.skipped) == ["000002", "000003"]
    assert source.skipped["000002"] == f"no color image of {COLOR} within 0.034 s, the nearest is 0.0667 s off"


def test_packed_color_and_gray_are_read_where_they_are_meant(tmp_path: Path) -> None:
    topic = f"{COLOR}/compressed"
    path = mcap(
        tmp_path, [*without(COLOR), (topic, EPOCH, ROS2.packed(EPOCH, png(color_of(7)), "rgb8; png compressed"))]
    )
    assert torch.equal(open_source(path).load("000000").colors[0], torch.from_numpy(color_of(7)))
    gray = color_of(3)[..., 0]
    path = mcap(tmp_path, [*without(COLOR), ("/cam/ir", EPOCH, ROS2.image(EPOCH, gray, "mono8"))], "gray")
    assert open_source(path).load("000000").colors is None
    frame = open_source(path, color="/cam/ir").load("000000")
    assert torch.equal(frame.colors[0], torch.from_numpy(gray)[..., None].expand(*SIZE, 3))


def test_images_that_cannot_be_right_are_refused_where_they_are(tmp_path: Path) -> None:
    short = ROS2.image(EPOCH, depth_of(0), "16UC1")
    short.data = short.data[:-2]
    huge = ROS2.image(EPOCH, depth_of(0), "16UC1")
    huge.height = huge.width = 1 << 20
    picture = ROS2.packed(EPOCH, packed_depth(depth_of(0).astype(np.uint8)), "16UC1; compressedDepth png")
    odd = ROS2.packed(EPOCH, packed_depth(depth_of(0)), "16UC1; compressedDepth zip")
    negative = ROS2.image(EPOCH, np.full(SIZE, -1, np.float32), "32FC1")
    words = {"is damaged": short, "must have 1": huge, "8-bit": picture, "packed as 'zip'": odd, "negative": negative}
    for number, (word, message) in enumerate(words.items()):
        entries = with_depth(DEPTHS["packed" if hasattr(message, "format") else "padded rows"])
        path = mcap(
            tmp_path,
            [*entries, (DEPTH, EPOCH + 1, message)]
            if not hasattr(message, "format")
            else [*entries[:-1], (DEPTH, EPOCH + 3 * STEP, message)],
            str(number),
        )
        source = open_source(path)
        refused = [one for one in source.ids if _refusal(source, one, word)]
        assert len(refused) == 1, word


def test_images_of_an_unknown_packing_are_named_with_it_and_a_damaged_first_image_hides_no_others(
    tmp_path: Path,
) -> None:
    odd = [ROS2.packed(EPOCH + n * STEP, packed_depth(depth_of(n)), "16UC1; compressedDepth zip") for n in range(4)]
    path = mcap(tmp_path, with_depth(lambda number, stamp: odd[number]), "odd")
    for options in ({}, {"depth": DEPTH}):
        with pytest.raises(CaptureError, match=r"cannot be read: depth is packed as 'zip'; known are png and rvl"):
            open_source(path, **options)
    first = [one for one in with_depth(DEPTHS["packed"]) if not (one[0] == DEPTH and one[1] == EPOCH)]
    source = open_source(mcap(tmp_path, [*first, (DEPTH, EPOCH, odd[0])], "first"))
    assert list(refused_captures(source)) == ["000000"]


def _refusal(source: Any, sample_id: str, word: str) -> bool:
    return word in refused_captures(source.subset([sample_id])).get(sample_id, "")


# -- cameras -----------------------------------------------------------------------------------------------------------


def with_info(**changes: Any) -> list[Entry]:
    infos = [
        ("/cam/depth/camera_info", EPOCH + n * STEP, ROS2.camera_info(EPOCH + n * STEP, **changes)) for n in range(2)
    ]
    return without("/cam/depth/camera_info", COLOR) + infos


def test_lenses_are_read_by_their_model_or_refused(tmp_path: Path) -> None:
    for model, lens in (("plumb_bob", [0.1, -0.2, 0.001, 0.002, 0.03]), ("rational_polynomial", [0.1] * 8)):
        camera = open_source(mcap(tmp_path, with_info(model=model, d=lens), model)).load("000000").camera
        assert camera.distortion.tolist() == [lens]
    fisheye = open_source(mcap(tmp_path, with_info(model="equidistant", d=[0.01, 0.0, 0.0, 0.0]), "equidistant"))
    assert fisheye.load("000000").camera.lenses == [("fisheye", [0.01, 0.0, 0.0, 0.0])]
    for number, (model, lens) in enumerate((("panini", [0.1] * 4), ("", [0.1] * 5), ("plumb_bob", [0.1] * 13))):
        with pytest.raises(IntrinsicsError, match="undistort the recording"):
            open_source(mcap(tmp_path, with_info(model=model, d=lens), f"refused_{number}"))


def test_a_region_of_the_sensor_and_binning_move_the_center(tmp_path: Path) -> None:
    k = [80.0, 0, 40.25, 0, 84.0, 25.75, 0, 0, 1]
    region = {"x_offset": 20, "y_offset": 4, "width": 32, "height": 24}
    path = mcap(tmp_path, with_info(size=(60, 80), k=k, roi=region, binning_x=2, binning_y=2))
    found = open_source(path).load("000000").camera.intrinsics[0]
    # Pixel p of the image is the mean of the sensor's pixels offset + 2 p and offset + 2 p + 1.
    assert found[0].tolist() == [40.0, 0.0, (40.25 - 20 + 0.5) / 2 - 0.5]
    assert found[1].tolist() == [0.0, 42.0, (25.75 - 4 + 0.5) / 2 - 0.5]


def test_a_camera_of_another_size_or_none_is_named_with_the_way_out(tmp_path: Path) -> None:
    with pytest.raises(IntrinsicsError, match=r"image of 32x24 pixels, the image has 16x12; name the right topic"):
        open_source(mcap(tmp_path, with_info(size=(24, 32))))
    with pytest.raises(IntrinsicsError, match="not calibrated; say intrinsics="):
        open_source(mcap(tmp_path, with_info(k=[0.0] * 9), "zero"))
    bare = mcap(tmp_path, without("/cam/depth/camera_info", "/cam/color/camera_info"), "bare")
    with pytest.raises(IntrinsicsError, match=r"no /cam/depth/camera_info; no topic describes a camera.*--intrinsics"):
        open_source(bare)
    camera = open_source(bare, intrinsics=(20, 21, 8, 6)).load("000000").camera
    assert camera.intrinsics[0, 0].tolist() == [20, 0, 8]
    moved = [
        (topic.replace("/cam/depth/camera_info", "/elsewhere"), *rest)
        for topic, *rest in without("/cam/color/camera_info")
    ]
    assert len(open_source(mcap(tmp_path, moved, "moved"))) == 4, "the only one of that frame"


def test_a_rectified_image_has_the_projection_and_no_lens(tmp_path: Path) -> None:
    p = [30.0, 0, 7.5, 0, 0, 31.0, 5.5, 0, 0, 0, 1, 0]
    entries = [(topic.replace("image_raw", "image_rect"), *rest) for topic, *rest in with_info(d=[0.1] * 5, p=p)]
    camera = open_source(mcap(tmp_path, entries)).load("000000").camera
    assert camera.distortion is None
    assert camera.intrinsics[0].tolist() == [[30, 0, 7.5], [0, 31, 5.5], [0, 0, 1]]


def test_a_zoom_during_the_recording_is_followed(tmp_path: Path) -> None:
    infos = [
        (
            "/cam/depth/camera_info",
            EPOCH + n * STEP,
            ROS2.camera_info(EPOCH + n * STEP, k=[20.0 + n, 0, 8, 0, 21, 6, 0, 0, 1]),
        )
        for n in range(4)
    ]
    source = open_source(mcap(tmp_path, without("/cam/depth/camera_info") + infos))
    assert [float(source.load(one).camera.intrinsics[0, 0, 0]) for one in source.ids] == [20, 21, 22, 23]


# -- which streams -----------------------------------------------------------------------------------------------------


def two_cameras() -> list[Entry]:
    left = [(topic.replace("/cam/", "/left/"), *rest) for topic, *rest in without(COLOR)]
    right = []
    for number in range(4):
        stamp = EPOCH + number * STEP + 10_000_000
        right.append(("/right/depth/image_raw", stamp, ROS2.image(stamp, depth_of(50 + number), "16UC1", "right")))
        right.append(("/right/depth/camera_info", stamp, ROS2.camera_info(stamp, "right")))
    right.append(("/tf_static", EPOCH - 5, ROS2.transform(0, "base", "right", (0, 0, 1))))
    return left + right


def test_several_depth_cameras_are_listed_and_read_as_views_or_one_by_one(tmp_path: Path) -> None:
    path = mcap(tmp_path, two_cameras())
    with pytest.raises(CaptureError, match=r"2 topics of depth; say which by depth=TOPIC") as caught:
        open_source(path)
    assert "/right/depth/image_raw (sensor_msgs/msg/Image, 4 messages, 30 Hz)" in str(caught.value)
    names = ["/left/depth/image_raw", "/right/depth/image_raw"]
    frame = open_source(path, depth=names, frame_id="base").load("000002")
    assert torch.equal(frame.depth, torch.stack([metres(depth_of(2)), metres(depth_of(52))]))
    assert frame.world_from_camera[1, :3, 3].tolist() == [0, 0, 1]
    assert frame.provenance["cameras"] == ["left", "right"]
    assert frame.provenance["stamp_ns"] == [EPOCH + 2 * STEP, EPOCH + 2 * STEP + 10_000_000]
    one = open_source(path, depth=names[1])
    assert torch.equal(one.load("000000").depth[0], metres(depth_of(50)))
    assert any(line.startswith(names[0]) for line in one.unread())
    with pytest.raises(ConfigError, match="did you mean '/right/depth/image_raw'"):
        open_source(path, depth="/right/depth/image")


def test_what_one_camera_lacks_is_said_of_that_camera(tmp_path: Path) -> None:
    names = ["/left/depth/image_raw", "/right/depth/image_raw"]
    entries = [one for one in two_cameras() if one[0] != "/right/depth/camera_info"]
    pixels = color_of(0)
    entries.append(("/left/color/image_raw", EPOCH, ROS2.image(EPOCH, pixels, "rgb8")))
    path = mcap(tmp_path, entries)
    with pytest.raises(IntrinsicsError, match=r'say intrinsics=\{"/right/depth/image_raw": \[FX, FY, CX'):
        open_source(path, depth=names)
    with pytest.raises(ConfigError, match=r'of one camera, and 2 are read; say of which: intrinsics=\{"/left/depth'):
        open_source(path, depth=names, intrinsics=(30, 31, 8, 6))
    with pytest.raises(
        ConfigError, match=r"metres_per_unit: no topic of images is called '/up'; there are /left/color"
    ):
        open_source(path, depth=names, metres_per_unit={"/up": 0.001})
    source = open_source(
        path, depth=names, intrinsics={names[1]: (30, 31, 8, 6)}, metres_per_unit={names[1]: 0.0001}, clock="header"
    )
    frame = source.load("000002")
    assert frame.camera.intrinsics[:, 0, 0].tolist() == [20, 30]
    torch.testing.assert_close(frame.depth, torch.stack([metres(depth_of(2)), metres(depth_of(52)) / 10]))
    assert frame.colors is None
    assert any("not all cameras that are read have color" in line for line in source.unread())


def test_what_holds_no_depth_is_told_with_its_topics(tmp_path: Path) -> None:
    with pytest.raises(
        CaptureError, match=r"(?s)no topic holds depth.*/joint_states \(sensor_msgs/msg/JointState, 20 mess"
    ) as caught:
        open_source(mcap(tmp_path, without(DEPTH)))
    assert "100 Hz" in str(caught.value)


def test_color_of_another_camera_is_told_and_registered_on_request(tmp_path: Path) -> None:
    pixels = np.zeros((24, 32, 3), np.uint8)
    other = [(COLOR, EPOCH + n * STEP, ROS2.image(EPOCH + n * STEP, pixels, "rgb8", "color_optical")) for n in range(4)]
    info = (
        "/cam/color/camera_info",
        EPOCH,
        ROS2.camera_info(EPOCH, "color_optical", size=(24, 32), k=[40.0, 0, 16, 0, 42, 12, 0, 0, 1]),
    )
    static = ("/tf_static", EPOCH - 1, ROS2.transform(0, "camera_optical", "color_optical", (0.05, 0, 0)))
    path = mcap(tmp_path, [*without(COLOR, "/cam/color/camera_info"), *other, info, static])
    source = open_source(path)
    assert source.load("000000").colors is None
    assert any(COLOR in line and "registered" in line for line in source.unread())
    frame = open_source(path, registered=True, frame_id="base").load("000001")
    assert frame.size == (24, 32)
    moved = torch.tensor(frame.provenance["registered"]["color_from_depth"])[0, :3, 3]
    assert torch.allclose(moved, torch.tensor([-0.05, 0, 0]).to(moved), atol=1e-12)
    bare = mcap(tmp_path / "bare", [*without(COLOR, "/cam/color/camera_info"), *other, info])
    with pytest.raises(CaptureError, match=r"(?s)'color_optical'.*--color-from-depth '16 numbers'"):
        open_source(bare, registered=True)
    matrix = [1, 0, 0, -0.05, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    given = open_source(bare, registered=True, color_from_depth=matrix).load("000001")
    assert torch.equal(given.depth, frame.depth)
    with pytest.raises(ConfigError, match="16 numbers"):
        open_source(bare, registered=True, color_from_depth="no")


# -- frames ------------------------------------------------------------------------------------------------------------


def test_transforms_that_contradict_each_other_are_told(tmp_path: Path) -> None:
    again = ("/tf_static", EPOCH, ROS2.transform(0, "hand", "camera_optical", (0.7, 0, 0)))
    path = mcap(tmp_path, [*without(), again])
    told = open_source(path, frame_id="base").unread()
    assert any("'camera_optical' in 'hand' 2 different static poses; the last counts" in line for line in told), told
    stamp = next(entry[1] for entry in without() if entry[0] == "/tf")
    moving = [("/tf", stamp + 1, ROS2.transform(stamp, "base", "hand", (x, 0, 0.5))) for x in (0.3, 0.9)]
    told = open_source(mcap(tmp_path / "two", [*without(), *moving]), frame_id="base").unread()
    assert any("'hand' in 'base' two different poses at one time, 1 times; the first counts" in line for line in told)
    told = open_source(mcap(tmp_path / "one", [*without()]), frame_id="base").unread()
    assert not any("different" in line for line in told)


def test_frames_that_are_not_connected_are_named_tree_by_tree(tmp_path: Path) -> None:
    island = ("/tf_static", EPOCH, ROS2.transform(0, "map", "odom", (0, 0, 0)))
    path = mcap(tmp_path, [*without(), island])
    with pytest.raises(
        CaptureError,
        match=r"does not connect 'camera_optical' with 'odom'. tree 1: base, camera_optical, hand; tree 2: map, odom",
    ):
        open_source(path, frame_id="odom")
    with pytest.raises(CaptureError, match=r"no frame 'world'; it has base, camera_optical, hand, map, odom"):
        open_source(path, frame_id="world")
    again = ("/tf_static", EPOCH, ROS2.transform(0, "map", "hand", (0, 0, 0)))
    with pytest.raises(CaptureError, match="gives the frame 'hand' two parents"):
        open_source(mcap(tmp_path, [*without(), again], "again"), frame_id="base")


def test_the_way_is_gone_forward_and_backward(tmp_path: Path) -> None:
    path = mcap(tmp_path, without())
    up, down = open_source(path, frame_id="base"), open_source(path, frame_id="camera_optical", poses={"base": "base"})
    assert torch.allclose(
        down.signals("000002")["base"].values[0], rigid.invert_rigid(up.load("000002").world_from_camera[0]), atol=1e-12
    )


def test_where_tf_has_a_gap_the_depth_is_left_out_with_the_reason(tmp_path: Path) -> None:
    kept = [entry for entry in without() if entry[0] != "/tf" or entry[1] < EPOCH + 40_000_000]
    source = open_source(mcap(tmp_path, kept), frame_id="base")
    assert source.ids == ["000000"] or source.ids == ["000000", "000001"]
    assert "tf from 'hand' to 'base' has no pose before and after it" in source.skipped["000003"]
    assert [one.id for one in source.episodes] == ["a"]


# -- signals -----------------------------------------------------------------------------------------------------------


def test_signals_of_one_s_own_are_joined_by_their_rule(tmp_path: Path) -> None:
    extra: list[Entry] = [("/command", EPOCH + n * 20_000_000 - 1, ROS2.numbers([n, -n])) for n in range(6)]
    extra += [
        ("/pose", EPOCH + n * 50_000_000, ROS2.pose(EPOCH + n * 50_000_000, "hand", (0.5 * n, 0, 0)))
        for n in range(-1, 4)
    ]
    extra += [("/task", EPOCH - 10**9, ROS2.text("pick the cube"))]
    path = mcap(tmp_path, [*without(), *extra])
    assert any("/command (std_msgs/msg/Float64MultiArray, 6 messages" in line for line in open_source(path).unread())
    said = {
        "command": {"kind": "invariant"},
        "pose": {"kind": "pose xyz_quat_xyzw", "frame": "hand"},
        "task": {"kind": "text"},
        "joint_states/position": None,
    }
    source = open_source(path, signals=said, frame_id="base")
    signals = source.signals("000001")  # at 33.3 ms
    assert set(signals) == {"command", "pose", "task"}
    assert signals["command"].values.tolist() == [[1.0, -1.0]]
    assert signals["task"].values == ("pick the cube",)
    x = 0.5 * STEP / 50_000_000
    hand = source._recordings[""].pose("base", "hand", EPOCH + STEP)
    expected = hand @ torch.tensor([x, 0, 0, 1]).double()
    assert signals["pose"].frame == "base"
    assert torch.allclose(signals["pose"].values[0, :3], expected[:3], atol=1e-9)
    assert source.load("000001").recorded_signals["pose"].same_bits(signals["pose"])
    nearest = open_source(path, signals={"command": {"kind": "invariant", "rule": "linear"}})
    assert nearest.signals("000001")["command"].values.tolist()[0] == pytest.approx(
        [STEP / 2e7 + 5e-8, -STEP / 2e7 - 5e-8], abs=1e-9
    )
    with pytest.raises(FrameError, match="frame_id"):
        open_source(path, signals=said)


def test_what_cannot_be_said_of_a_signal_is_refused(tmp_path: Path) -> None:
    extra = [("/command", EPOCH, ROS2.numbers([1.0])), ("/pose", EPOCH, ROS2.pose(EPOCH, "hand", (0, 0, 0)))]
    path = mcap(tmp_path, [*without(), *extra])
    for said, words in (
        ({"comand": {"kind": "invariant"}}, "did you mean 'command'"),
        ({"command": {"kind": "invariant", "rule": "cubic"}}, "rule must be one of"),
        ({"command": {"kind": "text"}}, "not of the kind"),
        ({"command": {"kind": "invariant", "rule": "slerp"}}, "joined by linear, nearest, step"),
        ({"pose": {"kind": "position", "frame": "hand"}}, "'pose matrix'"),
        ({"joint_states/position": {"kind": "position", "frame": "hand"}}, "not of the kind"),
        ({"command": {"kind": "invariant", "max_gap": -1}}, "positive seconds"),
        ("all", "mapping"),
    ):
        with pytest.raises(ConfigError, match=words):
            open_source(path, signals=said, frame_id="base")
    with pytest.raises(CaptureError, match="in the frame 'hand', signals says 'base'"):
        open_source(
            path, signals={"pose": {"kind": "pose matrix", "frame": "base"}}, frame_id="base", max_gap=1.0
        ).load("000000")


def test_joints_of_several_nodes_are_signals_of_their_own(tmp_path: Path) -> None:
    entries = [entry for entry in without() if entry[0] != "/joint_states"]
    for number in range(12):
        stamp = EPOCH + number * 10_000_000
        entries.append(("/joint_states", stamp, ROS2.joints(stamp, arm=float(number))))
        entries.append(("/joint_states", stamp + 1, ROS2.joints(stamp + 1, finger=-float(number), thumb=0.0)))
    signals = open_source(mcap(tmp_path, entries)).signals("000003")
    assert signals["joint_states/0/position"].values.tolist()[0] == pytest.approx([3 * STEP / 1e7])
    assert signals["joint_states/1/position"].values.tolist()[0] == pytest.approx([-3 * STEP / 1e7, 0], abs=1e-6)


def test_a_recording_that_states_what_it_holds_is_believed(tmp_path: Path) -> None:
    said = """{"schema": 1, "cameras": {"cam": {"metres_per_unit": 0.002}}, "samples": ["s_1", "s_2", "s_3", "s_4"],
     "signals": {"q": {"kind": "invariant", "dtype": "float32", "shape": [2, 2]}, "say": {"kind": "text"}},
     "episodes": [{"id": "pick", "first": 0, "length": 3, "attributes": {"ok": true}},
     {"id": "place", "first": 3, "length": 1}]}"""
    extra: list[Entry] = [("/pcdata", EPOCH - 1, ROS2.text(said))]
    for n in range(4):
        extra += [
            ("/signals/q", EPOCH + n * STEP, ROS2.numbers([n, 1, 2, 3])),
            ("/signals/say", EPOCH + n * STEP, ROS2.text(f"step {n}")),
        ]
    source = open_source(mcap(tmp_path, [*without("/joint_states"), *extra]))
    assert source.ids == ["s_1", "s_2", "s_3", "s_4"]
    assert [(one.id, one.length, dict(one.attributes)) for one in source.episodes] == [
        ("pick", 3, {"ok": True, "start_ns": EPOCH}), ("place", 1, {"start_ns": EPOCH + 3 * STEP})
    ]  # fmt: skip
    frame = source.load("s_3")
    assert frame.signals["q"].tolist() == [[[2, 1], [2, 3]]]
    assert frame.signals["q"].dtype == torch.float32
    assert frame.signals["say"] == ("step 2",)
    assert (frame.provenance["metres_per_unit"], frame.provenance["unit_is_recorded"]) == (0.002, True)
    for wrong in ('{"schema": 2}', "[]", '{"schema": 1, "signals": {"q": {"kind": "pose"}}}', '{"schema": 1, "x": 1}'):
        with pytest.raises(CaptureError, match="/pcdata"):
            open_source(
                mcap(tmp_path, [*without(), *extra[1:], ("/pcdata", EPOCH - 1, ROS2.text(wrong))], str(hash(wrong)))
            )


# -- clocks ------------------------------------------------------------------------------------------------------------


def test_the_clock_is_that_of_the_headers_unless_they_have_none(tmp_path: Path) -> None:
    path = mcap(tmp_path, without("/joint_states"))
    assert open_source(path, clock="recorded").load("000000").provenance["stamp_ns"] == EPOCH + 4_000_000
    unset = mcap(
        tmp_path,
        [
            *without(DEPTH, "/joint_states"),
            *((DEPTH, EPOCH + n * STEP, ROS2.image(0, depth_of(n), "16UC1")) for n in range(4)),
        ],
        "unset",
    )
    with pytest.raises(CaptureError, match=r"headers of its messages hold no time; clock='recorded'"):
        open_source(unset)
    assert len(open_source(unset, clock="recorded")) == 4
    with pytest.raises(ConfigError, match="clock must be one of header, recorded"):
        open_source(path, clock="wall")


def test_images_written_out_of_order_or_twice_stand_in_the_order_of_their_stamps(tmp_path: Path) -> None:
    stamps = [EPOCH + n * STEP for n in (2, 0, 1, 1)]
    entries = [
        *without(DEPTH, COLOR, "/joint_states"),
        *((DEPTH, EPOCH + n, ROS2.image(t, depth_of(n), "16UC1")) for n, t in enumerate(stamps)),
    ]
    source = open_source(mcap(tmp_path, entries))
    assert [
        torch.equal(source.load(one).depth[0], metres(depth_of(n))) for one, n in zip(source.ids, (1, 2, 3, 0))
    ] == [True] * 4


def test_a_build_keeps_how_the_streams_were_joined(tmp_path: Path) -> None:
    path = mcap(tmp_path, [entry for entry in without() if entry[0] != COLOR or entry[1] > EPOCH + 2 * STEP])
    source = open_source(path)
    build_dataset(config_from_yaml("depth: [Deproject]\n"), source, tmp_path / "set")
    manifest = Manifest.read(tmp_path / "set")
    assert list(manifest.streams) == source.streams
    color = next(one for one in manifest.streams if one["role"] == "color")
    assert (color["messages"], color["missing"]) == (2, 2)
    assert list(manifest.skipped) == ["000000", "000001"]
    assert f"color {COLOR}: 2 depth images have none" in source.unread()


# -- damage ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["bag", "mcap", "db3"])
def test_a_recording_that_was_cut_short_gives_what_is_there_and_says_what_is_not(tmp_path: Path, form: str) -> None:
    make = Types(1 if form == "bag" else 2)
    entries = [entry for entry in recording(make, count=40) if entry[0] in (DEPTH, "/cam/depth/camera_info")]
    path = written(tmp_path / ("a" if form == "db3" else f"a.{form}"), entries, make, form=form)
    if form == "db3":
        (path,) = path.glob("*.db3")
    data = path.read_bytes()
    cut = tmp_path / f"cut{path.suffix}"
    cut.write_bytes(data[: int(len(data) * 0.6)])
    source = open_source(cut)
    assert 5 < len(source) < 40
    for number, sample_id in enumerate(source.ids):
        assert torch.equal(source.load(sample_id).depth[0], metres(depth_of(number)))
    assert source.unread()[0].startswith(f"cut{path.suffix}: ")


@pytest.mark.parametrize("form", ["bag", "mcap", "db3"])
def test_damage_anywhere_is_a_typed_error_or_changes_readings_only(tmp_path: Path, form: str) -> None:
    make = Types(1 if form == "bag" else 2)
    path = written(tmp_path / ("a" if form == "db3" else f"a.{form}"), recording(make, count=2), make, form=form)
    if form == "db3":
        (path,) = path.glob("*.db3")
    data = path.read_bytes()
    draw = np.random.default_rng(3)
    for trial in range(25):
        bad = bytearray(data)
        for place in draw.integers(16, len(data), 20):
            bad[place] ^= int(draw.integers(1, 256))
        start = int(draw.integers(16, len(data) - 8))
        bad[start : start + 8] = b"\xff" * 8 if trial % 2 else b"\0" * 8
        file = tmp_path / f"bad{path.suffix}"
        file.write_bytes(bytes(bad))
        with suppress(PcdataError):
            source = open_source(file, kind="ros", frame_id="base")
            for sample_id in source.ids:
                source.load(sample_id)


@pytest.mark.parametrize("form", ["bag", "mcap"])
def test_packed_chunks_are_unpacked_once_for_all_topics(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str
) -> None:
    make = Types(1 if form == "bag" else 2)
    if form == "bag":
        monkeypatch.setattr(rosbag1.Writer, "write", closing(rosbag1.Writer.write, "chunk_threshold"))
    else:
        monkeypatch.setattr(storage_mcap.McapWriter, "write", closing(storage_mcap.McapWriter.write, "close_chunk"))
    path = written(tmp_path / f"a.{form}", recording(make, count=100), make, form=form, packed=True)
    unpacked: list[bytes] = []
    module = bag_file if form == "bag" else mcap_file
    original = module.unpacked

    def counted(content: bytes, *others: Any) -> bytes:
        unpacked.append(content)
        return original(content, *others)

    monkeypatch.setattr(module, "unpacked", counted)
    monkeypatch.setattr(chunked_file, "UNPACKED", Recent(10_000))  # far less than the recording
    assert len(open_source(path, frame_id="base")) == 100
    chunks = len(set(unpacked))
    assert chunks > 80
    # Besides the one pass: the first messages of topics, and those that show how joints are published.
    assert len(unpacked) < 1.5 * chunks


def closing(write: Any, what: str) -> Any:
    """Return what writes a message, and begins a chunk after every tenth."""
    count = itertools.count(1)

    def written(self: Any, *message: Any) -> None:
        if what == "chunk_threshold":
            self.chunk_threshold = -1 if next(count) % 10 == 0 else 1 << 20
        write(self, *message)
        if what == "close_chunk" and next(count) % 10 == 0:
            self.close_chunk()

    return written


def test_a_recording_is_sent_to_workers_without_its_messages(tmp_path: Path) -> None:
    source = open_source(mcap(tmp_path, without()), frame_id="base")
    content = pickle.dumps(source)
    assert len(content) < 20_000
    assert torch.equal(pickle.loads(content).load("000003").depth, source.load("000003").depth)


def test_a_topic_without_a_name_is_read_too(tmp_path: Path) -> None:
    entries = [(topic.replace(DEPTH, "/"), *rest) for topic, *rest in without(COLOR, "/cam/color/camera_info")]
    assert torch.equal(open_source(mcap(tmp_path, entries)).load("000001").depth[0], metres(depth_of(1)))
