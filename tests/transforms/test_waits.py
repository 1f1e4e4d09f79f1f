"""How often the host waits for another device in the chain of a live pipeline: what the page on devices says."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pcdata import transforms as T
from pcdata.structures import PointCloud
from pcdata.synthetic import tabletop
from tests import pretend_device
from tests.factories import assert_same
from tests.pretend_device import device, watching

pytestmark = pytest.mark.skipif(not pretend_device.AVAILABLE, reason="this PyTorch has no devices written in Python")

PAGE = Path(__file__).parents[2] / "docs" / "devices.md"
STEPS = (
    T.MaskDepth(near=0.2, far=3.0),
    T.RemoveFlyingPixels(),
    T.Deproject(),
    T.CropWorkspace(frame="camera", lower=(-0.4, -0.4, 0.2), upper=(0.4, 0.4, 1.5)),
    T.RemoveStatisticalOutliers(),
    T.RemoveRadiusOutliers(),
    T.RemovePlane(probability=0.9999),
    T.FarthestPointSample(num_points=64),
    T.EstimateNormals(),
)


def frame(num_views: int):
    made = tabletop(0, noise="stereo", size=(120, 160), num_views=num_views).frame
    return replace(made, labels=None)


def waits(num_views: int) -> dict[str, int]:
    here = frame(num_views)
    there = here.to(device())
    found = {}
    for step in STEPS:
        with watching() as watched:
            there = step(there)
        here = step(here)
        found[type(step).__name__] = watched.waits.total()
        if isinstance(here, PointCloud):
            assert_same(here, there.to("cpu"), tolerance=2e-6)
    return found


def table() -> dict[str, tuple[int, int]]:
    rows = re.findall(r"^\| `(\w+)` \| (\d+) \| (\d+) \|", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {name: (int(one), int(four)) for name, one, four in rows}


def test_the_page_tells_how_often_the_host_waits_in_every_step():
    told = table()
    assert list(told) == [type(step).__name__ for step in STEPS]
    one, four = waits(1), waits(4)
    assert told == {name: (one[name], four[name]) for name in one}


def test_steps_wait_at_most_once_for_what_they_leave_and_others_never():
    told = table()
    assert [told[name] for name in ("MaskDepth", "RemoveFlyingPixels", "FarthestPointSample")] == [(0, 0)] * 3
    assert [told[name] for name in ("Deproject", "CropWorkspace")] == [(1, 1)] * 2


def test_a_second_look_at_the_same_cloud_waits_for_nothing_that_is_known():
    cloud = T.Deproject()(frame(4).to(device()))
    crop = T.CropWorkspace(frame="camera", lower=(-9.0, -9.0, 0.0), upper=(9.0, 9.0, 9.0))
    with watching() as watched:
        assert crop(cloud).num_points == cloud.num_points
    assert watched.waits.total() == 1
    with watching() as watched:
        torch.cat([one.points for one in cloud])
        assert cloud.padded().points.shape[0] == 4
    assert watched.waits.total() <= 1, watched.waits
