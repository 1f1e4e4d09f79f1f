"""Depth images to points: masks, boxes and motions, what goes along, and what a reference refuses."""

from __future__ import annotations

import math

import pytest
import torch

from pcdata import functional as F
from pcdata.errors import CaptureError
from pcdata.functional.depth.boxed import deproject_into_box
from pcdata.functional.depth.deproject import deproject_images, mask_depth
from pcdata.rng import seeded
from tests.factories import assert_same
from tests.kernels.cuda import harness
from tests.kernels.cuda.inner_calls import cameras, depth_images

pytestmark = pytest.mark.skipif(harness.unavailable() is not None, reason=str(harness.unavailable()))
harness.register()

LENS = [0.1, -0.05, 0.001, -0.002, 0.01]
SIZES = [(1, 1, 1), (1, 1, 33), (3, 5, 7), (2, 16, 16), (4, 3, 90), (2, 40, 61)]


def equal(found: object, expected: object) -> None:
    assert_same(found, expected, tolerance=0.0)


@pytest.mark.parametrize("shape", SIZES)
def test_points_are_those_of_the_reference_bit_for_bit(shape, ordered):
    intrinsics, lenses = cameras(shape), torch.tensor([LENS] * shape[0], dtype=torch.float64)
    for holes, distortion in ((0.0, None), (0.3, None), (0.3, lenses), (1.0, lenses)):
        given = depth_images(shape, holes=holes), intrinsics
        found = F.deproject_depth(*given, distortion=distortion, backend=harness.BACKEND)
        expected = F.deproject_depth(*given, distortion=distortion, backend="torch")
        assert all(torch.equal(*pair) for pair in zip(found, expected, strict=True))


@pytest.mark.parametrize("shape", SIZES)
@pytest.mark.parametrize("is_moved", [False, True])
def test_a_box_takes_what_the_reference_takes_with_all_that_goes_along(shape, is_moved, ordered):
    depth, intrinsics = depth_images(shape).transpose(1, 2).contiguous().transpose(1, 2), cameras(shape)
    colors = torch.randint(0, 256, (*shape, 3), generator=seeded(1), dtype=torch.uint8)
    along = {"labels": torch.arange(depth.numel()).reshape(shape), "pairs": torch.rand((*shape, 2))}
    matrix = None
    if is_moved:
        matrix = torch.eye(4, dtype=torch.float64).repeat(shape[0], 1, 1)
        matrix[:, :3, 3] = torch.rand((shape[0], 3), generator=seeded(2), dtype=torch.float64)
    region = {"matrix": matrix, "lower": (-0.2, -0.1, 0.5), "upper": (0.4, 0.3, 1.9), "near": 0.5, "far": 2.0}
    mask = torch.rand(shape, generator=seeded(3)) < 0.8
    given = depth, intrinsics, None, colors, along
    for flying in (None, (0.01, 4)):
        found, expected = (
            deproject_into_box(*given, **region, mask=mask, flying=flying, backend=backend)
            for backend in (harness.BACKEND, "torch")
        )
        for one, other in zip(found, expected, strict=True):
            equal(one, other)
    whole, wanted = (deproject_images(*given, backend=backend) for backend in (harness.BACKEND, "torch"))
    equal(whole, wanted)


def test_a_mask_of_depths_is_the_reference_s(ordered):
    depth = depth_images((2, 9, 13))
    depth[0, 0, :4] = torch.tensor([math.nan, math.inf, -1.0, 0.5])
    mask = torch.rand(depth.shape, generator=seeded(3)) < 0.7
    for near, far, own in ((None, None, None), (0.5, None, mask), (None, 1.2, None), (0.5, 0.5, mask)):
        assert torch.equal(
            mask_depth(depth, near, far, own, backend=harness.BACKEND),
            mask_depth(depth, near, far, own, backend="torch"),
        )


def test_points_that_are_not_finite_leave_the_box_to_others():
    depth, intrinsics = depth_images((1, 4, 5)), cameras((1, 4, 5))
    matrix = torch.eye(4, dtype=torch.float64)[None] * 1e38
    region = {"lower": (0, 0, 0), "upper": (1, 1, 1), "near": None, "far": None, "mask": None}
    given = depth * 1e30, intrinsics, None, None, {}
    assert deproject_into_box(*given, matrix=matrix, **region, backend=harness.BACKEND) is None


def test_what_the_reference_refuses_is_refused_in_its_words():
    depth, intrinsics = depth_images((1, 60, 80)), cameras((1, 60, 80))
    barrel = torch.tensor([[-0.9, 0.0, 0.0, 0.0]], dtype=torch.float64)
    for bad, lens in ((torch.where(depth > 1, -depth, depth), None), (depth, barrel)):
        with pytest.raises(CaptureError) as expected:
            F.deproject_depth(bad, intrinsics, distortion=lens, backend="torch")
        with pytest.raises(CaptureError) as found:
            F.deproject_depth(bad, intrinsics, distortion=lens, backend=harness.BACKEND)
        assert str(found.value) == str(expected.value)
