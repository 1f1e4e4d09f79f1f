"""Flying pixels by the compiled core: those of the reference, at borders and between views too."""

from __future__ import annotations

import itertools

import pytest
import torch

from pcdata.contracts.dispatch import why_unavailable
from pcdata.functional.depth.flying_pixels import flying_pixel_mask
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
