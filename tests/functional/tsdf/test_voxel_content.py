"""Averaging a view into voxels that hold anything: the core gives the reference's bits."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from pcdata.contracts.dispatch import why_unavailable
from pcdata.functional import tsdf
from pcdata.rng import seeded
from tests.functional.tsdf.test_step_contract import GRID, view


@pytest.mark.skipif(why_unavailable("cpu") is not None, reason="the compiled core is not installed")
@pytest.mark.parametrize("weights", ["one", "many"])
@pytest.mark.parametrize("carve", [True, False])
def test_voxels_of_any_content_are_updated_as_by_the_reference(weights, carve):
    """First readings, the heaviest voxels, colors from one end of a channel to the other and with bits beyond."""
    generator = seeded(7)
    seen = view(0)
    extremes = torch.tensor([0, 1, 1019, 1020, 1023])[torch.randint(5, (3, *seen.depth.shape), generator=generator)]
    seen = dataclasses.replace(seen, color=(extremes[0] | extremes[1] << 10 | extremes[2] << 20).int())
    if weights == "one":
        seen = dataclasses.replace(seen, weight=None, label=None)
    made = []
    for _ in range(2):
        planes = tsdf.voxel_planes(colors=True, labels=weights == "many", views=weights == "many")
        field = tsdf.VoxelBlocks(planes, torch.device("cpu"))
        field.add(tsdf.touched_blocks(seen, GRID, backend="torch"))
        drawn = seeded(8)
        for name, plane in field.chunks[0].items():
            low, high = {"tsdf": (-32767, 32768), "color": (-(1 << 31), 1 << 31)}.get(name, (0, 32768))
            values = torch.randint(low, high, (len(field), 512), generator=drawn)
            if name in ("weight", "views"):
                values[torch.rand(values.shape, generator=drawn) < 0.5] //= 8192  # first readings and light voxels
                values[torch.rand(values.shape, generator=drawn) < 0.1] = 32767
            plane[: len(field)] = values.to(plane.dtype)
        made.append(field)
    for field, backend in zip(made, ("torch", "cpu"), strict=True):
        for _ in range(2):
            tsdf.integrate_view(field, torch.arange(len(field)), seen, GRID, carve=carve, backend=backend)
    for name, plane in made[0].chunks[0].items():
        assert torch.equal(plane, made[1].chunks[0][name]), name
