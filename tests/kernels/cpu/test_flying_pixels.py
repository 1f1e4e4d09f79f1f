"""Flying pixels by the compiled core: those of the reference, at borders and between views too."""

from __future__ import annotations

import itertools

import pytest
import torch

from pcdata.contracts.dispatch import why_unavailable
from pcdata.functional.depth.flying_pixels import flying_pixel_mask, without_flying_pixels
from pcdata.rng import seeded

pytestmark = pytest.mark.skipif(why_unavailable("cpu") is not None, reason="the compiled core is not there")


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 1, 7), (3, 5, 1), (2, 9, 300), (1, 130, 513), (0, 4, 4), (1, 0, 4)])
def test_flying_pixels_are_those_of_the_reference(shape):
    generator = seeded(3)
    depth = torch.randint(0, 4, shape, generator=generator).float() * 0.3
    depth += (depth > 0) * torch.rand(shape, generator=generator) * 0.02
    for tolerance, least in itertools.product((0.001, 0.02, torch.inf), (1, 3, 8)):
        ours, reference = (
            flying_pixel_mask(depth, tolerance=tolerance, min_neighbors=least, backend=backend)
            for backend in ("cpu", "torch")
        )
        assert torch.equal(ours, reference)


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 9, 300), (1, 130, 513), (0, 4, 4), (1, 0, 4)])
def test_depth_is_masked_on_the_way(shape):
    generator = seeded(4)
    depth = torch.randint(-1, 4, shape, generator=generator).float() * 0.3
    depth[torch.rand(shape, generator=generator) < 0.01] = torch.nan
    depth[torch.rand(shape, generator=generator) < 0.01] = torch.inf
    seen = torch.randint(0, 4, shape, generator=generator, dtype=torch.uint8)
    mask = torch.rand(shape, generator=generator) < 0.8
    for limits in ((None, None, None), (0.3, 0.6, None), (None, 0.7, mask), (0.5, None, mask.mT.contiguous().mT)):
        ours, reference = (
            without_flying_pixels(depth, seen, 0.02, 3, limits, backend=backend) for backend in ("cpu", "torch")
        )
        assert torch.equal(ours[0], reference[0])
        assert torch.equal(ours[1], reference[1])
    narrow = without_flying_pixels(depth[..., :1], None, 0.02, 3, (0.3, None, mask[..., :1]), backend="cpu")[0]
    assert torch.equal(
        narrow, without_flying_pixels(depth[..., :1], None, 0.02, 3, (0.3, None, mask[..., :1]), backend="torch")[0]
    )
