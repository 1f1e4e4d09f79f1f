"""keep_raw: the capture delivered beside its cloud is the capture."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from pcdata import Camera, DepthFrame, open_source
from pcdata.errors import CaptureError, WriteError
from pcdata.io.writers.capture_folder import write_capture
from pcdata.synthetic import tabletop


def _assert_read_back(frame: DepthFrame, folder) -> None:
    for v in range(frame.num_views):
        source = open_source(folder / f"view{v}")
        read, view = source.load(source.ids[0]), frame.view(v)
        assert torch.equal(read.depth, view.depth)
        assert torch.equal(read.camera.intrinsics, view.camera.intrinsics)
        assert read.camera.size == view.camera.size
        assert (read.colors is None) == (view.colors is None)
        if view.colors is not None:
            assert torch.equal(read.colors, view.colors)
        for name in ("labels", "mask", "confidence"):
            mine, theirs = getattr(view, name), getattr(read, name)
            assert theirs is None if mine is None else torch.equal(theirs, mine), name
        assert read.frame_id == view.frame_id
        if view.world_from_camera is not None:
            assert torch.equal(read.world_from_camera, view.world_from_camera)


def _frame(depth: torch.Tensor, **changes: object) -> DepthFrame:
    height, width = depth.shape[1:]
    camera = Camera.pinhole(fx=20.0, fy=21.0, cx=width / 2, cy=height / 2, size=(height, width))
    return DepthFrame(depth=depth, camera=camera, **changes)


def test_every_view_reads_back_equal(tmp_path):
    frame = tabletop(3, num_objects=2, num_views=2, noise="stereo", size=(24, 32)).frame
    write_capture(frame, tmp_path)
    _assert_read_back(frame, tmp_path)


def test_labels_without_an_object_and_masks_read_back(tmp_path):
    frame = tabletop(1, num_objects=2, size=(24, 32)).frame
    labels = frame.labels.clone()
    labels[:, :5] = -1
    labels[:, 5:7] = 65535  # a full 16 bits of ids: the background takes another one
    inside = torch.rand(labels.shape, generator=torch.Generator().manual_seed(0)) < 0.5
    marked = replace(frame, labels=labels, mask=inside, confidence=(labels > 0).to(torch.uint8))
    write_capture(marked, tmp_path)
    _assert_read_back(marked, tmp_path)


@pytest.mark.parametrize("label", [-2, 65536])
def test_labels_that_16_bits_cannot_hold_are_refused(tmp_path, label):
    frame = tabletop(1, num_objects=1, size=(24, 32)).frame
    with pytest.raises(CaptureError, match=r"write_labels.*0 .. 65535"):
        write_capture(replace(frame, labels=torch.full_like(frame.labels, label)), tmp_path)


def test_lens_distortion_reads_back(tmp_path):
    frame = tabletop(0, num_objects=1, size=(24, 32)).frame
    lens = torch.tensor([[0.1, -0.2, 0.001, 0.002, 0.05]], dtype=torch.float64)
    write_capture(replace(frame, camera=replace(frame.camera, distortion=lens)), tmp_path)
    source = open_source(tmp_path / "view0")
    assert torch.equal(source.load(source.ids[0]).camera.distortion, lens)


@pytest.mark.parametrize("unit", [0.001, 0.0002, 0.00025])
def test_whole_sensor_units_become_a_16_bit_png_of_the_same_values(tmp_path, unit):
    units = torch.randint(200, 65536, (1, 12, 16), generator=torch.Generator().manual_seed(0))
    units[0, :3] = 0
    depth = (units.double() * unit).float()
    frame = _frame(depth, provenance={"metres_per_unit": unit})
    write_capture(frame, tmp_path)
    assert (tmp_path / "view0" / "depth" / "0.png").is_file()
    _assert_read_back(frame, tmp_path)


@pytest.mark.parametrize(
    "change", [lambda d: d * 1.00001, lambda d: torch.nextafter(d, torch.tensor(9.0)), lambda d: d + 70.0]
)
def test_depth_that_units_cannot_say_exactly_stays_float(tmp_path, change):
    frame = _frame(change(torch.full((1, 12, 16), 1.234)), provenance={"metres_per_unit": 0.001})
    write_capture(frame, tmp_path)
    assert (tmp_path / "view0" / "depth" / "0.npy").is_file()
    _assert_read_back(frame, tmp_path)


def test_a_capture_without_color_and_pose_reads_back(tmp_path):
    frame = _frame(torch.full((1, 12, 16), 1.5))
    write_capture(frame, tmp_path)
    assert sorted(path.name for path in (tmp_path / "view0").iterdir()) == ["depth", "intrinsics.json"]
    _assert_read_back(frame, tmp_path)


def test_a_folder_that_cannot_be_written_is_a_capture_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CaptureError, match="cannot be written"):
        write_capture(_frame(torch.full((1, 12, 16), 1.5)), tmp_path / "file")


def test_nothing_is_written_over_or_beside(tmp_path):
    frame = tabletop(1, num_views=2, size=(24, 32)).frame
    (tmp_path / "view1").mkdir()
    with pytest.raises(WriteError, match=r"has view1 already.*choose a new folder"):
        write_capture(frame, str(tmp_path))
    assert [entry.name for entry in tmp_path.iterdir()] == ["view1"]


def test_the_views_of_a_capture_are_read_back_as_one(tmp_path):
    frame = tabletop(1, num_views=2, size=(24, 32)).frame
    write_capture(frame, str(tmp_path / "capture"))
    source = open_source(str(tmp_path / "capture"))
    read = source.load(source.ids[0])
    for name in ("depth", "colors", "labels", "world_from_camera"):
        assert torch.equal(getattr(read, name), getattr(frame, name)), name
