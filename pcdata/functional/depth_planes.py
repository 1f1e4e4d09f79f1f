"""Small planes fitted to the windows of a depth image: surface points and normals, the noise averaged out."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pcdata.functional.depth import pixel_rays

# Half the width of a window, as a tangent: 5.5 mm at 1 m. Wider loses the sides of small objects, which alone show a
# camera that slid along the table; narrower leaves their normals too noisy to tell relief from noise.
_HALF_WINDOW = 0.0055
_MIN_VALID = 0.7  # of a window's pixels
_MAX_ROUGHNESS = 2.0  # times the image's median residual: windows across an edge, or on strongly bent surfaces
_FLOOR_ROUGHNESS = 3e-4  # metres: what a perfect sensor's curved surfaces are allowed
_MAX_WIDER = 1.1  # times the variance within the nine parts; on a plane the two differ by a few per cent
MIN_COSINE = 0.2  # between ray and normal: flatter ones are mostly noise


@dataclass(frozen=True, eq=False)
class DepthPlanes:
    """A grid of planes ``coefficients . X = 1`` in the camera's frame, one per window of one depth image."""

    coefficients: Tensor  # (h, w, 3) float64, 1/metre
    points: Tensor  # (h, w, 3) float64, where the window's mean ray meets its plane
    normals: Tensor  # (h, w, 3) float64 unit, towards the camera
    depth: Tensor  # (h, w) float64 of the points, 0 = the window holds no plane
    sigma: Tensor  # (h, w) float64 metres, standard deviation of the plane along its normal at its point
    normal_sigma: Tensor  # (h, w) float64 radians, standard deviation of the normal along each tangent
    is_flat: Tensor  # (h, w) bool, the plane is that of a window three times as wide
    first: int  # pixel coordinate of the first window's centre, both ways
    stride: int  # pixels between windows
    window: int  # pixels across a window


def fit_depth_planes(
    depth: Tensor,  # (H, W) float32 metres, 0 = no reading
    intrinsics: Tensor,  # (3, 3) pixels
    distortion: Tensor | None = None,  # (D,)
) -> DepthPlanes:
    """Fit a plane to every window of a depth image, by least squares in inverse depth.

    On a plane 1/z is linear in the rays (x/z, y/z), whatever the lens, and a stereo camera's noise is uniform in 1/z.
    A window holds no plane where fewer than 70 per cent of its pixels have a reading, where its residual is more than
    twice the image's median (a depth edge), or where it is seen at less than 12 degrees. Where one plane fits a window
    three times as wide as well as its nine parts, that plane is taken: flat ground gets normals nine times as true.
    """
    window = 2 * max(1, round(_HALF_WINDOW * float(intrinsics[0, 0]))) + 1
    stride = max(1, window // 3 + 1)
    moments = _window_moments(depth, intrinsics, distortion, window, stride)
    fine = _plane_of(moments, _MIN_VALID * window * window)
    noise = fine.residual[fine.holds].median() if bool(fine.holds.any()) else depth.new_zeros((), dtype=torch.float64)
    limit = _MAX_ROUGHNESS * torch.maximum(noise, _FLOOR_ROUGHNESS * fine.inverse_depth.square())
    smooth = fine.holds & (fine.residual <= limit)

    step = round(window / stride)
    wide = _plane_of(_sum_around(moments, step), 9 * _MIN_VALID * window * window)
    parts = torch.stack([smooth.double(), torch.where(smooth, fine.residual.square(), 0.0)])
    whole, variance = _sum_around(parts, step)
    is_flat = wide.holds & (whole == 9) & (wide.residual.square() <= _MAX_WIDER * variance / 9)

    coefficients = torch.where(is_flat[..., None], wide.coefficients, fine.coefficients)
    count = torch.where(is_flat, wide.count, fine.count)
    length = coefficients.norm(dim=-1)
    rays = torch.stack([fine.x, fine.y, torch.ones_like(fine.x)], -1)
    inverse_depth = (coefficients * rays).sum(-1)
    cosine = inverse_depth / (length * rays.norm(dim=-1))
    holds = smooth & (cosine >= MIN_COSINE) & (inverse_depth > 0)
    safe = torch.where(holds, inverse_depth, 1.0)
    # An error e of 1/z moves the surface by e / (1/z) / |coefficients| along its normal.
    sigma = torch.where(holds, noise / (safe * length) / count.sqrt(), 0.0)
    across = torch.where(is_flat, 3.0, 1.0) * window / float(intrinsics[0, 0]) / safe  # metres, the narrower way
    return DepthPlanes(
        coefficients=coefficients,
        points=rays / safe[..., None],
        normals=-coefficients / torch.where(holds, length, 1.0)[..., None],
        depth=torch.where(holds, 1 / safe, 0.0),
        sigma=sigma,
        normal_sigma=math.sqrt(12) * sigma / across,  # of the slope of a line fitted over a width
        is_flat=is_flat & holds,
        first=window // 2,
        stride=stride,
        window=window,
    )


@dataclass(frozen=True, eq=False)
class _WindowFit:
    count: Tensor  # pixels
    x: Tensor  # the mean ray
    y: Tensor
    inverse_depth: Tensor  # mean
    coefficients: Tensor
    residual: Tensor  # standard deviation of 1/z about the plane
    holds: Tensor  # enough pixels that span a plane


def _plane_of(moments: Tensor, min_count: float) -> _WindowFit:
    """Solve the least squares of windows whose moments (10, h, w) are given."""
    count = moments[0].clamp(min=1e-12)
    x, y, xx, xy, yy, d, dx, dy, dd = moments[1:] / count
    xx, xy, yy = xx - x * x, xy - x * y, yy - y * y
    dx, dy, dd = dx - d * x, dy - d * y, dd - d * d
    determinant = xx * yy - xy * xy
    holds = (moments[0] >= min_count) & (determinant > 1e-6 * (xx + yy).square())
    safe = torch.where(holds, determinant, 1.0)
    a, b = (dx * yy - dy * xy) / safe, (dy * xx - dx * xy) / safe
    residual = (dd - a * dx - b * dy).clamp(min=0).sqrt()
    return _WindowFit(count, x, y, d, torch.stack([a, b, d - a * x - b * y], -1), residual, holds)


def _sum_around(images: Tensor, step: int) -> Tensor:  # (C, h, w) -> (C, h, w)
    """Add up each cell and its eight neighbours at ``step`` cells; outside counts as 0."""
    padded = torch.nn.functional.pad(images, (step,) * 4)
    height, width = images.shape[1:]
    offsets = [(row * step, column * step) for row in range(3) for column in range(3)]
    return torch.stack([padded[:, row : row + height, column : column + width] for row, column in offsets]).sum(0)


def _window_moments(
    depth: Tensor, intrinsics: Tensor, distortion: Tensor | None, window: int, stride: int
) -> Tensor:  # (10, h, w) float64
    """Sum 1, x, y, xx, xy, yy, d, dx, dy, dd over each window's valid pixels, d = 1/z."""
    size = (depth.shape[0], depth.shape[1])
    rays = pixel_rays(intrinsics[None].double(), size, None if distortion is None else distortion[None].double())[0]
    valid = (depth > 0) & torch.isfinite(rays).all(-1)
    ones = valid.double()
    x, y = (torch.where(valid, axis, 0.0) for axis in rays.unbind(-1))
    d = torch.where(valid, 1 / torch.where(valid, depth, 1.0).double(), 0.0)
    images = torch.stack([ones, x, y, x * x, x * y, y * y, d, d * x, d * y, d * d])[:, None]
    if min(size) < window:
        return images.new_zeros(10, 0, 0)
    rows = torch.nn.functional.avg_pool2d(images, (window, 1), (stride, 1), divisor_override=1)
    return torch.nn.functional.avg_pool2d(rows, (1, window), (1, stride), divisor_override=1)[:, 0]
