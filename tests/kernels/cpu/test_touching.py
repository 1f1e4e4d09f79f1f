"""The kernels of touching objects give what their references give: the same regions, planes and strengths."""

from __future__ import annotations

import pytest
import torch

from pcdata.functional.touching.contacts import region_contacts, region_planes
from pcdata.functional.touching.limits import KINECT_NOISE, Limits
from pcdata.functional.touching.regions import smooth_regions
from pcdata.functional.touching.windows import PixelCamera, is_steep, rays, window_planes


def heap(seed: int, noise: float) -> torch.Tensor:
    """Boxes and balls at random before nothing, with holes: (H, W) inverse depth."""
    generator = torch.Generator().manual_seed(seed)
    rows, columns = torch.meshgrid(torch.arange(50.0), torch.arange(64.0), indexing="ij")
    inverse = torch.zeros(50, 64, dtype=torch.float64)
    for number in range(6):
        middle = torch.rand(2, generator=generator) * torch.tensor([40.0, 54.0]) + 5
        size = 8 + 8 * float(torch.rand(1, generator=generator))
        v, u = rows - middle[0], columns - middle[1]
        lean = torch.rand(2, generator=generator) * 0.02 - 0.01
        shape = 1.1 + lean[0] * v + lean[1] * u
        inside = torch.maximum(v.abs(), u.abs()) < size
        if number % 2:
            inside = v * v + u * u < size * size
            shape = 1.1 + 0.01 * (size * size - v * v - u * u).clamp(min=0).sqrt()
        inverse = torch.where(inside & (shape > inverse), shape.double(), inverse)
    jitter = noise * torch.randn(inverse.shape, generator=generator, dtype=torch.float64)
    hole = torch.rand(inverse.shape, generator=generator) < 0.03
    return torch.where((inverse > 0) & ~hole, inverse + jitter, 0.0)


CAMERA = PixelCamera(260.0, 250.0, 33.0, 20.0)


@pytest.mark.parametrize("noise", [KINECT_NOISE / 2, KINECT_NOISE, 3 * KINECT_NOISE])
@pytest.mark.parametrize(("seed", "roughest"), [(1, 1.0), (2, 1.5), (3, 2.0)])
def test_regions_and_contacts_equal_the_reference(seed, noise, roughest):
    inverse = heap(seed, noise)
    limits = Limits(seed_area=4e-5, roughest=roughest, rough_area=6e-5, part_area=8e-5)
    own = smooth_regions(inverse, CAMERA, noise, limits, backend="cpu")
    expected = smooth_regions(inverse, CAMERA, noise, limits, backend="torch")
    assert int(expected.label.max()) > 0  # several regions
    assert (own.normals - expected.normals).abs().max() < 1e-12  # equal but for the last digit
    assert torch.equal(own.label, expected.label)
    own, expected = (
        region_contacts(inverse, expected.label, CAMERA, noise, limits, backend=backend) for backend in ("cpu", "torch")
    )
    assert len(expected.first) > 0
    assert all(map(torch.equal, own, expected))


@pytest.mark.parametrize("length", [10, 14, 20])
def test_regions_are_cut_over_smeared_steps_as_in_the_reference(length):
    part = ((torch.arange(64.0, dtype=torch.float64) - 30) / length).clamp(0, 1)
    inverse = (1 + 0.15 * part * part * (3 - 2 * part)).expand(50, 64) + 0.1 * (heap(2, KINECT_NOISE) > 0)
    planes = window_planes(inverse, inverse > 0, torch.full_like(inverse, 4), CAMERA, KINECT_NOISE, Limits())
    rows, columns = rays(inverse.shape, CAMERA, inverse.device)
    assert 0 < int(is_steep(planes, columns, rows, CAMERA, Limits()).sum()) < inverse.numel()
    own, expected = (
        smooth_regions(inverse, CAMERA, KINECT_NOISE, Limits(seed_area=4e-5, part_area=8e-5), backend=backend).label
        for backend in ("cpu", "torch")
    )
    assert int(expected.max()) > 1
    assert torch.equal(own, expected)


def test_an_image_of_one_pixel_and_one_without_readings_have_no_region():
    for inverse in (torch.ones(1, 1, dtype=torch.float64), torch.zeros(4, 5, dtype=torch.float64)):
        found = smooth_regions(inverse, CAMERA, KINECT_NOISE, Limits(), backend="cpu")
        assert (found.label == -1).all()
        assert (found.normals == 0).all()
    none = torch.zeros(0, dtype=torch.int64)
    assert region_planes(inverse, found.label, none, CAMERA, KINECT_NOISE, Limits(), backend="cpu").shape == (0, 6)


def test_what_is_too_rough_for_the_first_seeds_becomes_one_where_rough_ones_are_asked_for():
    inverse = heap(1, KINECT_NOISE)
    few, many = (
        smooth_regions(inverse, CAMERA, KINECT_NOISE, Limits(seed_area=4e-5, roughest=one, rough_area=4e-5))
        for one in (1.0, 2.0)
    )
    assert int(many.label.max()) > int(few.label.max())
