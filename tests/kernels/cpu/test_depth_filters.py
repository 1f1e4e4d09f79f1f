"""Filters of depth images by the core: those of the reference where bands, stripes and pieces of images end."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import pcdata.functional.depth.temporal
import pcdata.structures.filled_depth  # noqa: F401 - registers what is called by name
from pcdata import functional as F
from pcdata.contracts.dispatch import INNER, OPERATIONS, why_unavailable
from pcdata.kernels.cpu import depth_filters
from pcdata.rng import seeded

pytestmark = pytest.mark.skipif(why_unavailable("cpu") is not None, reason="the compiled core is not there")

SHAPES = [(1, 1, 1), (2, 1, 7), (3, 5, 1), (2, 33, 129), (1, 64, 128), (1, 31, 300), (2, 70, 127), (0, 4, 4), (1, 0, 4)]
each_shape = pytest.mark.parametrize("shape", [*SHAPES, (1, 4, 0)], ids=str)


def image(shape: tuple[int, ...], holes: float = 0.2) -> Tensor:
    """Two surfaces in blocks of pixels, noise, lone holes and wide ones."""
    draw = seeded(5)
    depth = 0.5 + 0.1 * (torch.arange(shape[-1]) // 9 % 2) + 0.01 * torch.rand(shape, generator=draw)
    depth[..., shape[1] // 3 : shape[1] // 2, shape[2] // 4 : shape[2] // 2] = 0
    return torch.where(torch.rand(shape, generator=draw) < holes, 0.0, depth)


def same(name: str, *given: object, **rules: object) -> None:
    ours, theirs = (OPERATIONS[name].public(*given, **rules, backend=backend) for backend in ("cpu", "torch"))
    assert all(map(torch.equal, *((found if isinstance(found, tuple) else (found,)) for found in (ours, theirs))))


@each_shape
def test_windows_are_those_of_the_reference(shape):
    for reach in (1, 2, 3):
        same("median_filter", image(shape), reach=reach)
        same("median_filter", image(shape), reach=reach, max_jump=0.02)
        same("bilateral_filter", image(shape), reach=reach)
    same("bilateral_filter", image(shape), reach=7, max_jump=torch.inf)


@each_shape
@pytest.mark.parametrize("threads", [1, 3])
def test_averages_are_those_of_the_reference_with_any_number_of_threads(shape, threads):
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        for delta in (0.005, 0.05, torch.inf):
            same("spatial_filter", image(shape), delta=delta, iterations=3)
        scale = torch.linspace(1, 2, shape[0])
        given = image(shape), scale, 1 / (image(shape) + 0.1), torch.full(shape, 0b10110101, dtype=torch.uint8)
        for persistence in range(9):
            step = INNER["temporal_step"]
            ours, theirs = (body(*given, 0.4, 0.3, persistence) for body in (step.public, step.reference))
            assert all(map(torch.equal, ours, theirs))
    finally:
        torch.set_num_threads(before)


@each_shape
@pytest.mark.parametrize("rule", ["left", "farthest", "nearest"])
def test_holes_are_filled_as_by_the_reference(shape, rule):
    for holes in (0.1, 0.9, 1.0):
        for max_size in (None, 1, 2, 7, 1000):
            same("fill_holes", image(shape, holes), rule=rule, max_size=max_size)


def test_images_of_more_pixels_than_the_core_numbers_are_left_to_the_reference(monkeypatch):
    monkeypatch.setattr(depth_filters, "_MAX_PIXELS", 10)
    monkeypatch.setattr(depth_filters, "call", None)
    depth = image((1, 4, 9))
    same("fill_holes", depth)
    filled, far = INNER["filled_images"].public(depth, "nearest", None, 1)
    assert torch.equal(filled, F.fill_holes(depth, rule="nearest")[0])
    assert torch.equal(far, F.fill_holes(depth, rule="nearest")[1] > 1)


def test_a_gradient_that_is_wanted_leaves_filters_to_the_reference():
    depth = image((1, 9, 20)).requires_grad_()
    for found in (F.bilateral_filter(depth), F.median_filter(depth), F.fill_holes(depth)[0]):
        found.sum().backward()
        assert bool((depth.grad > 0).any())
        depth.grad = None
