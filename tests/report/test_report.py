"""Reports: tables that line up, and a picture of what happened."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pcdata import Camera, DepthFrame, PointCloud
from pcdata.build import BuildReport, BuiltSample
from pcdata.errors import MissingExtraError
from pcdata.io import open_source, write_ply
from pcdata.io.sources.source import Source
from pcdata.report import save_pipeline_figure, text_table
from pcdata.report.build_text import build_text
from pcdata.report.capture_facts import capture_facts
from pcdata.report.inspection_text import facts_text
from pcdata.synthetic import tabletop

needs_matplotlib = pytest.mark.skipif(importlib.util.find_spec("matplotlib") is None, reason="matplotlib is absent")


def test_a_table_aligns_texts_left_and_numbers_right():
    assert text_table(["step", "points"], [["crop", 1234567], ["voxel", 8]]).splitlines() == [
        "step      points",
        "-----  ---------",
        "crop   1,234,567",
        "voxel          8",
    ]


def test_a_table_of_nothing_is_its_header():
    assert text_table(["a", "b"], []).splitlines() == ["a  b", "-  -"]


def test_build_text_gives_fewest_median_and_most_of_every_step():
    samples = [BuiltSample(str(n), "depth", [("Deproject", 1000 * n), ("Crop", n)], 0.5) for n in (1, 2, 6)]
    lines = build_text(BuildReport(Path("x"), samples)).splitlines()
    assert lines[0] == "3 samples in 1.5 s"
    assert lines[4].split() == ["Deproject", "1,000", "2,000", "6,000"]
    assert lines[5].split() == ["Crop", "1", "2", "6"]


def test_build_text_says_which_captures_skipped_the_depth_section():
    samples = [BuiltSample("a", "cloud", [("Crop", 3)], 0.0), BuiltSample("b", "depth", [("Deproject", 3)], 0.0)]
    assert "clouds already, which entered at the first step that takes one: 1 capture" in build_text(
        BuildReport(Path("x"), samples)
    )


def test_build_text_of_a_pipeline_without_steps_is_still_a_report():
    assert build_text(BuildReport(Path("x"), [BuiltSample("a", "cloud", [], 0.1)])).startswith("1 sample in")


def test_capture_text_of_a_cloud_file_tells_its_extent(tmp_path):
    points = torch.tensor([[0.0, -1.0, 0.5], [2.0, 1.0, 0.25]])
    write_ply(tmp_path / "one.ply", PointCloud(points=points, frame_id="camera"))
    text = facts_text(capture_facts(open_source(tmp_path)))
    for part in ("clouds", "one", "x 0.000 to 2.000", "y -1.000 to 1.000", "z 0.250 to 0.500"):
        assert part in text


class _Source(Source):
    kind = "test"

    def __init__(self, capture):
        super().__init__(Path("none"), ["a"])
        self.capture = capture

    @classmethod
    def recognizes(cls, path):
        return False

    def files(self, sample_id):
        return {}

    def _load(self, sample_id):
        return self.capture


def test_captures_with_nothing_in_them_are_described_too():
    camera = Camera.pinhole(fx=9.0, fy=9.0, cx=4.0, cy=3.0, size=(6, 8))
    blank = DepthFrame(depth=torch.zeros(1, 6, 8), camera=camera)
    assert "0 of 48 pixels valid" in facts_text(capture_facts(_Source(blank)))
    assert "empty" in facts_text(capture_facts(_Source(PointCloud(points=torch.zeros(0, 3), frame_id="camera"))))


@needs_matplotlib
def test_the_picture_is_a_png_that_changes_with_the_clouds(tmp_path):
    scene = tabletop(0, num_objects=1, size=(24, 32))
    draw = torch.Generator().manual_seed(0)
    points = torch.rand(200, 3, generator=draw)
    plain = PointCloud(points=points, frame_id="base")
    full = PointCloud(points=points, frame_id="camera", colors=points, normals=torch.nn.functional.normalize(points))
    for name, stages in (("one", [("raw", plain), ("raw", full)]), ("two", [("raw", plain)])):
        save_pipeline_figure(tmp_path / f"{name}.png", scene.frame, stages, title="title")
    with Image.open(tmp_path / "one.png") as one, Image.open(tmp_path / "two.png") as two:
        assert one.format == two.format == "PNG"
        assert one.width > 400
        assert one.height > 300
        assert np.asarray(one).std() > 5  # something is drawn
        assert one.size != two.size or np.asarray(one).tobytes() != np.asarray(two).tobytes()


@needs_matplotlib
def test_odd_clouds_are_drawn_without_an_error(tmp_path):
    frame = tabletop(0, num_objects=1, size=(24, 32)).frame
    one_point = PointCloud(points=torch.ones(1, 3), frame_id="base")
    nothing = PointCloud(points=torch.zeros(0, 3), frame_id="base", colors=torch.zeros(0, 3))
    one, both = [("one", one_point)], [("none", nothing), ("one", one_point)]
    for capture, stages in ((frame, both), (one_point, []), (nothing, one)):
        save_pipeline_figure(tmp_path / "a.png", capture, stages)
        assert (tmp_path / "a.png").stat().st_size > 1000


@needs_matplotlib
def test_a_capture_that_is_a_cloud_is_drawn_as_one(tmp_path):
    cloud = PointCloud(points=torch.rand(200, 3, generator=torch.Generator().manual_seed(0)), frame_id="camera")
    save_pipeline_figure(tmp_path / "one.png", cloud, [("raw", cloud)])
    save_pipeline_figure(tmp_path / "other.png", cloud.with_fields(points=2 * cloud.points), [("raw", cloud)])
    assert (tmp_path / "one.png").read_bytes() != (tmp_path / "other.png").read_bytes()


def test_without_matplotlib_the_picture_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"pcdata\[viz\]"):
        save_pipeline_figure(tmp_path / "a.png", tabletop(0, num_objects=1, size=(24, 32)).frame, [])
