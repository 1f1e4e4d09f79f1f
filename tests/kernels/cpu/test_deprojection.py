"""The compiled deprojection gives the reference's points bit for bit: any camera, thread count, instruction set."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from pcdata.contracts.dispatch import why_unavailable
from pcdata.functional.depth.deproject import deproject_depth
from tests.kernels.cpu.clouds import assert_equal_to_reference

REASON = why_unavailable("cpu")
pytestmark = pytest.mark.skipif(REASON is not None, reason=str(REASON))


def depth_images(views: int, height: int, width: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    depth = torch.rand((views, height, width), generator=generator) + 0.3
    return torch.where(torch.rand(depth.shape, generator=generator) < 0.3, 0.0, depth)


def camera(views: int, width: int, height: int, skew: float = 0.0, dtype: torch.dtype = torch.float64) -> Tensor:
    one = torch.tensor([[0.9 * width, skew, width / 2 - 0.3], [0, 0.8 * width, height / 2 + 0.7], [0, 0, 1]])
    return (one.double() + torch.arange(views)[:, None, None] * torch.tensor([[3.0, 0, 1], [0, 2, 1], [0, 0, 0]])).to(
        dtype
    )


LENSES = {
    "none": None,
    "4": [0.1, -0.02, 0.001, -0.002],
    "8": [0.1, -0.02, 0.001, -0.002, 0.003, 0.01, 0.002, 0.001],
}


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("skew", [0.0, 0.7])
@pytest.mark.parametrize("size", [(1, 1), (61, 83)])
def test_deprojection_equals_the_reference(lens, skew, size, machine):
    coefficients = LENSES[lens]
    distortion = None if coefficients is None else torch.tensor([coefficients, coefficients])
    for dtype in (torch.float32, torch.float64):
        intrinsics = camera(2, size[1], size[0], skew, dtype)
        case = (lens, skew, size, dtype)
        assert_equal_to_reference(deproject_depth, depth_images(2, *size), intrinsics, distortion=distortion, case=case)


@pytest.mark.parametrize(
    "depth",
    [
        torch.zeros(2, 5, 6),
        torch.ones(2, 5, 6),
        torch.ones(2, 0, 6),
        torch.ones(2, 5, 0),
        -torch.ones(2, 5, 6),
        torch.full((2, 5, 6), math.nan),
        torch.full((2, 5, 6), 1e-45),
        torch.full((2, 5, 6), -0.0),
        depth_images(2, 12, 10)[:, ::2].transpose(1, 2),
    ],
    ids=["nothing", "full", "no rows", "no columns", "negative", "NaN", "denormal", "minus zero", "strided"],
)
def test_unusual_depth_images_give_what_the_reference_gives(depth):
    assert_equal_to_reference(deproject_depth, depth, camera(2, 6, 5))


def test_impossible_cameras_raise_what_the_reference_raises():
    depth = depth_images(1, 40, 50)
    for intrinsics in (-camera(1, 50, 40), camera(1, 50, 40).mT.contiguous(), camera(1, 50, 40) * 0):
        assert_equal_to_reference(deproject_depth, depth, intrinsics)
    folding = torch.tensor([[-2.0, 0.5, 0.0, 0.0]])
    assert_equal_to_reference(
        deproject_depth, depth, camera(1, 50, 40) * torch.tensor([0.2, 1.0, 1.0]), distortion=folding
    )


def test_a_real_frame_gives_the_references_points(frame, machine):
    assert_equal_to_reference(deproject_depth, *frame, case=("real",))
