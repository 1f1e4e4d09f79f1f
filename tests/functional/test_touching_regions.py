"""Regions of a depth image end where a sensor has smeared a jump into a ramp, and nowhere on one surface."""

from __future__ import annotations

import math

import pytest
import torch

from pcdata.functional.touching.limits import KINECT_NOISE, Limits
from pcdata.functional.touching.parts import cut_regions, jumps
from pcdata.functional.touching.regions import smooth_regions
from pcdata.functional.touching.separation import _without_lines
from pcdata.functional.touching.windows import PixelCamera

CAMERA = PixelCamera(500.0, 500.0, 59.5, 39.5)
ROWS, COLUMNS, RAMP_FROM = 60, 120, 50


def smeared_step(length: int, near: float) -> torch.Tensor:
    """Show (H, W) of 1/z: what is 1 m away left, and nearer right; the step is smeared over columns."""
    part = ((torch.arange(COLUMNS, dtype=torch.float64) - RAMP_FROM) / length).clamp(0, 1)
    part = part * part * (3 - 2 * part)
    noise = 0.1 * KINECT_NOISE * torch.randn(ROWS, COLUMNS, generator=torch.Generator().manual_seed(3)).double()
    return 1 + part * (1 / near - 1) + noise


@pytest.mark.parametrize("near", [0.9, 0.85])
@pytest.mark.parametrize("length", [10, 14, 20])
def test_no_region_reaches_over_a_step_that_is_smeared(length, near):
    inverse = smeared_step(length, near)
    assert not any(one.any() for one in jumps(inverse, inverse > 0, Limits().jump * KINECT_NOISE))
    label = smooth_regions(inverse, CAMERA, KINECT_NOISE, Limits()).label
    middle = RAMP_FROM + length // 2
    behind, before = label[:, : middle - 2].unique(), label[:, middle + 3 :].unique()
    assert not torch.isin(behind, before).any()


@pytest.mark.parametrize("degrees", [0, 45, 65, 80])
def test_one_surface_is_one_region_however_it_leans(degrees):
    rows = torch.arange(ROWS, dtype=torch.float64)[:, None] - CAMERA.cy
    inverse = 1 / 0.8 * (1 + math.tan(math.radians(degrees)) * rows / CAMERA.fy) + torch.zeros(1, COLUMNS)
    label = smooth_regions(inverse, CAMERA, KINECT_NOISE, Limits()).label
    assert (label == 0).all()


def cut(label: torch.Tensor, steep: torch.Tensor, least: int, *, jumps_at: tuple[int, ...] = ()) -> list[list[int]]:
    """Cut where parts have so many pixels, each a square metre; jumps lie behind some columns."""
    inverse = torch.ones(label.shape, dtype=torch.float64)
    across, along = (label[:, 1:] < -9), (label[1:] < -9)
    across[:, list(jumps_at)] = True
    camera, limits = PixelCamera(1.0, 1.0, 0.0, 0.0), Limits(part_area=least)
    return cut_regions(inverse, label, steep, across, along, camera, limits).tolist()


def test_parts_take_the_line_between_them_and_are_numbered_by_their_first_pixels():
    label = torch.tensor([[1, 1, 1, 1, 1, -1, 0, 0]] * 2)
    steep = torch.zeros(2, 8, dtype=torch.bool)
    assert cut(label, steep, 4) == [[0, 0, 0, 0, 0, -1, 1, 1]] * 2
    steep[:, 2] = True
    assert cut(label, steep, 4) == [[0, 0, 0, 1, 1, -1, 2, 2]] * 2  # reached from both at once: the lower one's
    steep[:, 3] = True
    assert cut(label, steep, 2) == [[0, 0, 0, 1, 1, -1, 2, 2]] * 2


def test_small_parts_stay_with_their_region():
    label = torch.zeros(2, 5, dtype=torch.int64)
    steep = torch.tensor([[False, True, False, False, False]] * 2)
    assert cut(label, steep, 3) == [[0] * 5] * 2
    assert cut(label, steep, 2) == [[0, 0, 1, 1, 1]] * 2
    assert cut(label, torch.ones_like(steep), 1) == [[0] * 5] * 2  # steep everywhere
    steep[0, 1] = False  # the line has a gap
    assert cut(label, steep, 2) == [[0] * 5] * 2
    assert cut(label, steep, 2, jumps_at=(2,)) == [[0, 0, 0, 1, 1]] * 2
    assert cut(label, steep, 5, jumps_at=(2,)) == [[0] * 5] * 2
    assert cut(label, steep, 4, jumps_at=(0,)) == [[0] * 5] * 2  # one part is too small


def test_an_image_without_a_region_or_a_pixel_has_nothing_to_cut():
    for shape in ((3, 4), (0, 4), (3, 0)):
        label = torch.full(shape, -1)
        assert cut(label, torch.zeros(shape, dtype=torch.bool), 1) == label.tolist()


@pytest.mark.parametrize("turned", [False, True])
def test_a_missing_line_is_filled_as_a_slope_and_a_jump_beside_it_stays_one(turned):
    limit = Limits().jump * KINECT_NOISE
    for step, is_jump in ((10 * KINECT_NOISE, True), (3 * KINECT_NOISE, False)):
        inverse = 1 + step * (torch.arange(COLUMNS) >= RAMP_FROM).double().expand(ROWS, COLUMNS)
        inverse[:, RAMP_FROM] = 0
        inverse = inverse.T.contiguous() if turned else inverse
        filled = _without_lines(inverse, 2 * limit)
        assert (filled > 0).all()
        found = jumps(filled, filled > 0, limit)[1 if turned else 0]
        assert bool(found.any()) == is_jump
        middle = filled[RAMP_FROM] if turned else filled[:, RAMP_FROM]
        assert torch.allclose(middle, torch.tensor(1 if is_jump else 1 + step / 2, dtype=torch.float64))
