"""Panels say what was gathered: since when a camera is off, gaps, planes, objects, episodes over time."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from pcdata import Camera, Compose, DepthFrame, PointCloud
from pcdata.report.html.capture_report import page_of_captures
from pcdata.report.html.charts import curves, strip, time_line
from pcdata.report.html.gathering import Gathered, gather_captures
from pcdata.report.html.overlaps import GAP, overlap_of
from pcdata.report.html.scene import raw_cloud, stage_of
from pcdata.report.html.unpacking import unpack_cloud
from pcdata.synthetic import tabletop
from pcdata.transforms import ClusterObjects, Deproject, MergeViews, NormalizeUnitSphere, RemovePlane, ToFrame
from pcdata.validation import SampleReport, validate_frame
from pcdata.validation.by_camera import cameras_of
from pcdata.validation.grading import Grading
from pcdata.verdicts import Finding, Verdict
from tests.report.html.recorded import MOVED_FROM, NUM_FRAMES, SIZE, Recorded, rig_frames


@pytest.fixture(scope="module")
def gathered() -> Gathered:
    chain = Compose(
        [
            Deproject(),
            ToFrame(frame="base"),
            MergeViews(),
            RemovePlane(up=(0, 0, 1), frame="base", max_tilt=0.2, keep="above"),
            ClusterObjects(eps=0.03, min_points=12, min_size=30),
            NormalizeUnitSphere(),
        ]
    )
    return gather_captures(Recorded(rig_frames()), pipeline=chain, num_shown=3)


@pytest.fixture(scope="module")
def page(gathered) -> str:
    return page_of_captures(gathered)


def body_of(page: str) -> str:
    return page.split("<main>")[1].split("<script")[0]


def test_the_camera_that_moved_is_the_first_thing_told(page):
    body = body_of(page)
    first = body[body.index('class="finding') :].split("</div>")[0]
    assert "view_pose view 1 (front)" in first
    assert "from &#x27;f3&#x27; on" in first
    assert 'data-sample="0">show f3<' in first


def test_every_camera_says_since_when(gathered, page):
    left, front, right = cameras_of(gathered.grading)
    assert front.name == "view 1 (front)"
    assert front.verdict is Verdict.FAIL
    assert front.since == "from 'f3' on, in 3 of 6 captures"
    assert (front.severities == 3).tolist() == [False] * 3 + [True] * 3
    assert {left.verdict, right.verdict} == {Verdict.PASS}
    assert "from &#x27;f3&#x27; on, in 3 of 6 captures: view_pose" in body_of(page)
    (told,) = [camera for camera in gathered.grading.to_json()["cameras"] if camera["view"] == 1]
    assert told["since"] == front.since
    assert told["counts"]["fail"] == 3


def test_the_plane_is_where_it_was_made_and_as_noisy(gathered):
    trends = gathered.grading.trends
    for view in range(3):
        heights = np.array(trends["plane_height", view].values)
        tilts = np.array(trends["plane_tilt", view].values)
        assert np.abs(heights[:MOVED_FROM]).max() < 0.004  # metres: the table of the synthetic scene is at 0
        assert tilts[:MOVED_FROM].max() < 0.2
    quiet = tabletop(0, size=SIZE).frame
    (noise,) = [one for one in validate_frame(quiet) if one.name == "plane_noise"]
    assert noise.value is not None
    assert noise.value < 1e-4 < min(trends["plane_noise", 0].values)


def test_gaps_between_cameras_are_told_and_drawn(gathered, page):
    one = gathered.looked[0]
    assert {(pair.first, pair.second) for pair in one.pairs} >= {("view 0 (left)", "view 1 (front)")}
    assert one.scene is not None
    stage = one.scene.stages[0]
    gaps = unpack_cloud(stage.cloud).fields[GAP]
    there = np.isfinite(gaps)
    assert 0.05 < there.mean() < 1.0  # what one camera alone saw has none
    assert np.nanmin(gaps) >= 0
    assert np.nanmedian(gaps) < 3.0  # mm
    assert stage.cloud.said["total"] == int((rig_frames()[MOVED_FROM].depth > 0).sum())
    assert "Overlap of cameras" in page


def test_a_gap_is_the_distance_between_surfaces():
    frame = rig_frames()[0]
    lifted = frame.world_from_camera.clone()
    lifted[1, 2, 3] += 0.008  # metres: the surface of the second camera lies so much higher
    overlap = overlap_of(replace(frame, world_from_camera=lifted))
    assert overlap is not None
    cloud = raw_cloud(replace(frame, world_from_camera=lifted))
    shown = overlap.shown_on(cloud, 5000)
    gaps = shown.extra[GAP]
    near_table = (shown.points[:, 2] > 0.004) & (shown.points[:, 2] < 0.012) & torch.isfinite(gaps)
    assert near_table.sum() > 50
    assert float(gaps[near_table].median()) == pytest.approx(8.0, abs=1.0)


def test_one_view_or_no_poses_have_no_gaps():
    frame = rig_frames()[0]
    assert overlap_of(frame.view(0)) is None
    assert overlap_of(replace(frame, world_from_camera=None, frame_id=None)) is None


def test_objects_are_counted_and_measured(gathered, page):
    for one in gathered.looked:
        assert one.objects is not None
        assert 3 <= len(one.objects) <= 6  # five stand there; a neighbor may be close
        assert all(0.01 < edge < 0.4 for box in one.objects for edge in box)
        assert [*one.objects] == sorted(one.objects, reverse=True)
    assert "boxes, length x width x height [cm]" in page


def test_an_episode_shows_its_gap_and_its_signals(gathered, page):
    (line,) = gathered.lines
    assert line.name == "pick"
    assert line.gaps == ((4, pytest.approx(3.1)),)
    assert line.signals["joints<b>"].tolist() == [[n, -n] for n in range(NUM_FRAMES)]
    assert "task" not in line.signals  # a text is no curve
    body = body_of(page)
    assert "f4 after 3.1 s" in body
    assert "joints&lt;b&gt;" in body
    assert "joints<b>" not in page


def test_a_page_is_below_its_limit_whatever_is_shown():
    frames = rig_frames()
    packed = [gather_captures(Recorded(frames), num_shown=count).looked for count in (1, 6)]
    sizes = [sum(len(s.cloud.content) for one in looked if one.scene for s in one.scene.stages) for looked in packed]
    assert max(sizes) <= 15 << 20


@pytest.mark.parametrize("count", [0, 1, 2, 5000, 100_000])
def test_charts_of_any_length_are_small_and_keep_the_worst(count):
    values = np.random.default_rng(0).normal(size=count)
    severities = np.zeros(count, dtype=np.int8)
    if count:
        values[count // 3] = 50.0
        severities[count // 2] = 3
    line, band = time_line(values, severities, limit=1.0), strip(severities)
    assert len(line) < 500_000
    assert len(band) < 100_000
    assert line.count("#e5484d") == band.count("#e5484d") == int(count > 0)
    drawn = curves({"a<b": values}, "mm")
    assert len(drawn) < 100_000
    if count:
        assert "to 50 mm" in drawn


def test_curves_break_where_nothing_was_measured():
    values = np.array([1.0, 2.0, np.nan, 3.0, np.nan, np.nan, 4.0, 5.0])
    drawn = curves({"a": values, "b<": values + 1}, "mm")
    assert drawn.count("<polyline") == 4
    assert drawn.count("h0") == 2  # what stands alone is a dot
    assert "b&lt;" in drawn
    assert not re.search(r"nan|inf", drawn)
    assert "no numbers" in curves({"a": np.full(3, np.nan)}, "mm")


def test_what_was_not_measured_is_no_pass_of_a_camera():
    grading = Grading(["a", "b"])
    unknown, fine = Finding(name="one", verdict=Verdict.UNKNOWN, view=0), Finding(name="two", view=0, value=1.0)
    grading.add(SampleReport("a", (unknown,), views=("view 0 (x)",)))
    grading.add(SampleReport("b", (unknown, fine), views=("view 0 (y)",)))
    (camera,) = cameras_of(grading)
    assert camera.severities.tolist() == [1, 0]
    assert camera.name == "view 0"  # captures name it differently
    assert camera.since == ""


def test_the_view_is_of_what_is_near_where_far_things_lie_behind():
    generator = torch.Generator().manual_seed(0)
    table = torch.rand(4000, 3, generator=generator) * torch.tensor([0.8, 0.5, 0.1]) + torch.tensor([-0.4, -0.25, 0.9])
    wall = torch.rand(6000, 3, generator=generator) * torch.tensor([5.0, 4.0, 0.5]) + torch.tensor([-2.5, -2.0, 3.0])
    for points, far in ((torch.cat([table, wall]), 1.2), (table, 1.2), (wall, 4.0)):
        cloud = PointCloud(points=points, frame_id="camera", viewpoint=torch.zeros(1, 3))
        view = stage_of("", cloud).cloud.said["view"]
        assert view["upper"][2] < far
        assert view["upper"][2] > points[:, 2].min()


def test_where_a_cut_background_explains_the_holes_no_exposure_is_raised():
    depth = torch.full((120, 160), 0.8)
    depth[:, :70] = 0
    advice = {kind: _advice(frame) for kind, frame in (("cut", depth), ("sparse", _sparse(0.5)))}
    assert advice["cut"].startswith("one region explains it: right where the background was cut away on purpose")
    assert advice["sparse"].startswith("raise the exposure")


def _sparse(share: float) -> torch.Tensor:
    read = torch.rand(120, 160, generator=torch.Generator().manual_seed(0)) < share
    return torch.where(read, 0.8, 0.0)


def _advice(depth: torch.Tensor) -> str:
    camera = Camera.pinhole(fx=150, fy=150, cx=80, cy=60, size=(120, 160))
    found = validate_frame(DepthFrame(depth=depth[None], camera=camera))
    (finding,) = [one for one in found if one.name == "valid_fraction"]
    assert finding.verdict is not Verdict.PASS
    return finding.advice
