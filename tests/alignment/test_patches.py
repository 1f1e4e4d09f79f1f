import math

import pytest
import torch

from pcdata.alignment.patches import fit_depth_patches
from pcdata.functional.depth.deproject import pixel_rays

SIZE = (120, 160)
INTRINSICS = torch.tensor([[600.0, 0.0, 79.0], [0.0, 590.0, 61.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
LENS = torch.tensor([-0.2, 0.05, 1e-3, -5e-4, 0.0], dtype=torch.float64)


def rays(distortion: torch.Tensor | None = None) -> torch.Tensor:
    seen = pixel_rays(INTRINSICS[None], SIZE, None if distortion is None else distortion[None])[0]
    return torch.nn.functional.pad(seen, (0, 1), value=1.0)


def plane_depth(normal: torch.Tensor, distance: float, distortion: torch.Tensor | None = None) -> torch.Tensor:
    """Depth of the plane normal . X = distance."""
    return distance / (rays(distortion) @ normal)


def sphere_depth(center: torch.Tensor, radius: float) -> torch.Tensor:
    direction = rays()
    a, b = direction.square().sum(-1), direction @ center
    root = b.square() - a * (center.square().sum() - radius**2)
    return torch.where(root > 0, (b - root.clamp(min=0).sqrt()) / a, 0.0)


@pytest.mark.parametrize("distortion", [None, LENS])
def test_patches_of_a_slanted_plane_lie_on_it(distortion):
    normal = torch.nn.functional.normalize(torch.tensor([0.5, -0.6, 0.9], dtype=torch.float64), dim=0)
    found = fit_depth_patches(plane_depth(normal, 0.7, distortion), INTRINSICS, distortion)
    there = found.depth > 0
    assert float(there.double().mean()) > 0.9
    assert float((found.points[there] @ normal - 0.7).abs().max()) < 2e-6
    assert float((found.normals[there] + normal).norm(dim=1).max()) < (1e-6 if distortion is None else 1e-3)
    assert int(found.half.max()) == 9


def test_patches_of_a_ball_lie_on_it_where_planes_would_lie_inside():
    center, radius = torch.tensor([0.0, 0.0, 0.9], dtype=torch.float64), 0.04
    found = fit_depth_patches(sphere_depth(center, radius), INTRINSICS)
    outside = (found.points[found.depth > 0] - center).norm(dim=1) - radius
    assert len(outside) > 100
    assert float(outside.abs().median()) < 5e-5
    # The mean of a window 11 mm wide lies deeper by the curvature times the window's variance: a tenth of a millimetre
    # and more where it is seen at a slant.
    flat = (0.011**2 / 12) / radius
    assert abs(float(outside.mean())) < flat / 2


def test_each_pixel_counts_once_in_the_uncertainty_of_all_patches():
    generator = torch.Generator().manual_seed(0)
    sigma = 2e-3  # of 1/z
    inverse = 1 / 0.8 + sigma * torch.randn(SIZE, generator=generator, dtype=torch.float64)
    found = fit_depth_patches(1 / inverse, INTRINSICS)
    there = found.depth > 0
    information = found.sigma[there].square().reciprocal().sum() / int(there.sum()) / found.stride**2
    facing = 0.8**2 * sigma  # metres, of one pixel
    assert float(information.rsqrt()) == pytest.approx(facing, rel=0.05)
    error = (found.depth[there] - 0.8).std()
    assert float(error) < facing / found.stride


def test_the_stated_error_of_normals_is_what_noise_does_to_them():
    generator = torch.Generator().manual_seed(1)
    inverse = 1 / 0.8 + 2e-3 * torch.randn(SIZE, generator=generator, dtype=torch.float64)
    found = fit_depth_patches(1 / inverse, INTRINSICS)
    wide = found.half == found.half.max()
    assert float(wide.double().mean()) > 0.7
    slope = found.normals[wide][:, 0]
    # Where the plane is seen askew by its noise the patch keeps it: x of the normal errs by one standard deviation.
    assert float(slope.std() / found.normal_sigma[wide].median()) == pytest.approx(1.0, abs=0.25)


def test_no_patch_spans_a_step():
    depth = torch.full(SIZE, 1.0, dtype=torch.float64)
    depth[:, 80:] = 0.9
    found = fit_depth_patches(depth, INTRINSICS)
    there = found.depth > 0
    assert float(torch.minimum((found.depth - 1.0).abs(), (found.depth - 0.9).abs())[there].max()) < 1e-4
    columns = found.first + found.stride * torch.arange(there.shape[1])
    assert not bool(there[:, ((columns - 79.5).abs() < 3)].any())


@pytest.mark.parametrize("size", [SIZE, (5, 5), (1, 1)])
def test_an_image_without_readings_has_no_patch(size):
    found = fit_depth_patches(torch.zeros(size), INTRINSICS)
    assert int((found.depth > 0).sum()) == 0
    assert math.prod(found.depth.shape) == math.prod(found.sigma.shape)
