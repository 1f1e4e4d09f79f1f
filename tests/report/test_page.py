"""Clouds, captures and chains show themselves as pages, and say what they are in some lines."""

from __future__ import annotations

import html
import json

import pytest
import torch

from pcdata import Compose, DepthFrame, PointCloud
from pcdata.errors import TooFewPointsError
from pcdata.report import Page
from pcdata.transforms import Deproject, FarthestPointSample, RandomJitter
from tests.factories import cloud_in_base, tabletop_frame


def stages(page: Page) -> list[dict]:
    return json.loads(page.html.split('id="pcdata-index">')[1].split("</script>")[0])[0]["stages"]


def test_a_cloud_shows_all_its_points(tmp_path):
    cloud = cloud_in_base()
    page = cloud.show()
    (stage,) = stages(page)
    assert stage["cloud"]["count"] == cloud.num_points
    assert stage["cloud"]["frame"] == "base"
    assert page.save(tmp_path / "view.html").read_text(encoding="utf-8") == page.html
    (fewer,) = stages(cloud.show(max_points=100))
    assert fewer["cloud"]["count"] <= 100 < fewer["cloud"]["total"] == cloud.num_points


def test_a_notebook_gets_a_frame_of_its_own():
    shown = cloud_in_base((5,)).show()._repr_html_()
    assert shown.startswith('<iframe srcdoc="')
    assert html.unescape(shown.split('srcdoc="')[1].split('"')[0]) == cloud_in_base((5,)).show().html
    assert 'sandbox="allow-scripts"' in shown


def test_a_capture_shows_its_views_where_they_are():
    frame = tabletop_frame(2)
    (stage,) = stages(frame.show())
    assert stage["cloud"]["total"] == int((frame.depth > 0).sum())
    assert stage["cloud"]["frame"] == frame.frame_id
    assert "cameras" in [line["name"] for line in stage["lines"]]


def test_a_chain_shows_what_every_step_left():
    frame = tabletop_frame(1)
    chain = Compose([Deproject(), FarthestPointSample(num_points=64), RandomJitter()])
    shown = stages(chain.show_steps(frame, generator=torch.Generator().manual_seed(0)))
    assert [stage["caption"] for stage in shown] == ["capture", "Deproject", "FarthestPointSample", "RandomJitter"]
    assert [stage["cloud"]["total"] for stage in shown][2:] == [64, 64]


def test_grasps_are_drawn_where_they_are():
    grasps = torch.eye(4, dtype=torch.float64)[None].repeat(2, 1, 1)
    grasps[1, :3, 3] = torch.tensor([0.0, 0.0, 1.0])
    (stage,) = stages(cloud_in_base((50,)).show(grasps=grasps))
    drawn = next(line for line in stage["lines"] if line["name"] == "grasps")
    ends = torch.tensor(drawn["segments"]).reshape(2, -1, 3)
    assert torch.allclose(ends[1] - ends[0], torch.tensor([0.0, 0.0, 1.0]))


@pytest.mark.parametrize("counts", [(0,), (1,), (0, 3)])
def test_small_clouds_are_shown_too(counts):
    cloud = cloud_in_base(counts)
    assert stages(cloud.show())[0]["cloud"]["count"] == sum(counts)
    assert cloud.summary().startswith(repr(cloud))


def test_a_summary_says_bounds_and_spacing():
    line = torch.zeros(11, 3)
    line[:, 0] = 0.1 * torch.arange(11)
    told = PointCloud(points=line, labels=torch.arange(11) - 1, frame_id="base").summary().splitlines()
    assert told[1] == "bounds: x 0 to 1, y 0 to 0, z 0 to 0 m"
    assert told[2].startswith("spacing: 0.1 m")
    assert told[3] == "labels: int64, -1 to 9, 11 values"


def test_images_without_a_reading_are_refused_as_elsewhere():
    frame = tabletop_frame(1)
    empty = DepthFrame(depth=torch.zeros_like(frame.depth), camera=frame.camera)
    with pytest.raises(TooFewPointsError, match="no reading"):
        empty.show()
