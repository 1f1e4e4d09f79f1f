"""Depth registered to color: larger and smaller images, edges, lenses, and what floats cannot hold."""

from __future__ import annotations

import pytest
import torch

from pcdata import functional as F
from pcdata.errors import CaptureError
from pcdata.rng import seeded
from tests.kernels.cuda import harness
from tests.kernels.cuda.inner_calls import cameras, depth_images

pytestmark = pytest.mark.skipif(harness.unavailable() is not None, reason=str(harness.unavailable()))
harness.register()

LENS = [0.1, -0.05, 0.001, -0.002, 0.01]


def beside(views: int) -> torch.Tensor:
    matrix = torch.eye(4, dtype=torch.float64).repeat(views, 1, 1)
    matrix[:, :3, 3] = 0.05 * torch.rand((views, 3), generator=seeded(4), dtype=torch.float64)
    return matrix


def agree(depth: torch.Tensor, intrinsics: torch.Tensor, **arguments) -> list[torch.Tensor]:
    given = depth, intrinsics, arguments.pop("color_intrinsics", intrinsics), arguments.pop("motion", None)
    given = *given[:3], beside(len(depth)) if given[3] is None else given[3]
    found = F.register_depth(*given, backend=harness.BACKEND, **arguments)
    expected = F.register_depth(*given, backend="torch", **arguments)
    assert all(torch.equal(*pair) for pair in zip(found, expected, strict=True))
    return list(found)


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 1, 9), (2, 13, 1), (1, 7, 40), (3, 24, 31)])
def test_images_of_any_size_are_registered_bit_for_bit(shape, ordered):
    depth, intrinsics = depth_images(shape), cameras(shape)
    for size in ((1, 1), shape[1:], (2 * shape[1], 3 * shape[2]), (50, 3)):
        agree(depth, intrinsics, color_size=size)
    assert ordered.started


def test_lenses_of_both_cameras_are_known(ordered):
    depth, intrinsics = depth_images((2, 20, 26), holes=0.1), cameras((2, 20, 26))
    lens = torch.tensor([LENS, [0.0] * 5], dtype=torch.float64)
    found = agree(depth, intrinsics, color_size=(30, 40), distortion=lens, color_distortion=lens, max_jump=0.05)
    assert bool((found[0] > 0).any())


def test_surfaces_hide_what_is_behind(ordered):
    shape = (1, 30, 40)
    depth = torch.ones(shape)
    depth[:, 8:20, 10:25] = 0.4
    found = agree(depth, cameras(shape), color_size=shape[1:], max_jump=0.02)
    assert bool(found[3].any())
    assert bool(found[2].any())


def test_all_holes_no_view_and_an_infinite_jump(ordered):
    shape = (2, 6, 9)
    found = agree(torch.zeros(shape), cameras(shape), color_size=(5, 5))
    assert not found[0].any()
    agree(torch.zeros((0, 6, 9)), cameras(shape)[:0], color_size=(5, 5))
    agree(depth_images(shape), cameras(shape), color_size=(8, 11), max_jump=torch.inf)


def test_what_the_kernels_cannot_hold_is_left_to_the_reference(ordered):
    shape = (1, 5, 6)
    far = cameras(shape)
    far[:, 0, 0] = 1e36
    agree(depth_images(shape), cameras(shape), color_size=(4, 4), color_intrinsics=far)
    fisheye = torch.tensor([[0.1, 0.0, 0.0, 0.0] + [0.0] * 8 + [0.02, 0.01]], dtype=torch.float64)  # tilted
    agree(depth_images(shape), cameras(shape), color_size=(4, 4), color_distortion=fisheye)


def test_a_reading_without_a_ray_is_refused_in_the_reference_s_words():
    depth, intrinsics = depth_images((1, 60, 80), holes=0.0), cameras((1, 60, 80))
    barrel = torch.tensor([[-0.9, 0.0, 0.0, 0.0]], dtype=torch.float64)
    told = []
    for backend in ("torch", harness.BACKEND):
        with pytest.raises(CaptureError) as error:
            F.register_depth(
                depth, intrinsics, intrinsics, beside(1), color_size=(9, 9), distortion=barrel, backend=backend
            )
        told.append(str(error.value))
    assert told[0] == told[1]
