"""Small planes fitted to the windows of a depth image: surface points and normals with most of the noise averaged out."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pcdata.functional.depth import pixel_rays

# Half the width of a window, as a tangent: 8.5 mm at 1 m. Narrower leaves the normals of a stereo camera noisier than
# 3 degrees; wider loses the sides of small objects.
_HALF_WINDOW = 0.0085
_MIN_VALID = 0.7  # of a window's pixels
_MAX_ROUGHNESS = 2.0  # times the image's median residual: windows across an edge, or on strongly bent surfaces
_FLOOR_ROUGHNESS = 3e-4  # metres: what a perfect sensor's curved surfaces are allowed
_MIN_COSINE = 0.2  # between ray and normal: flatter ones are mostly noise


@dataclass(frozen=True, eq=False)
class DepthPlanes:
    """A grid of planes ``coefficients . X = 1`` in the camera's frame, one per window of one depth image."""

    coefficients: Tensor  # (h, w, 3) float64, 1/metre
    points: Tensor  # (h, w, 3) float64, where the window's mean ray meets its plane
    normals: Tensor  # (h, w, 3) float64 unit, towards the camera
    depth: Tensor  # (h, w) float64 of the points, 0 = the window holds no plane
    sigma: Tensor  # (h, w) float64 metres, standard deviation of the plane along its normal at its point
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
    twice the image's median (a depth edge), or where it is seen at less than 12 degrees.
    """
    window = 2 * max(1, round(_HALF_WINDOW * float(intrinsics[0, 0]))) + 1
    stride = max(1, window // 3 + 1)
    moments = _window_moments(depth, intrinsics, distortion, window, stride)
    count = moments[0].clamp(min=1e-12)
    x, y, xx, xy, yy, d, dx, dy, dd = moments[1:] / count
    xx, xy, yy = xx - x * x, xy - x * y, yy - y * y
    dx, dy, dd = dx - d * x, dy - d * y, dd - d * d
    determinant = xx * yy - xy * xy
    enough = (moments[0] >= _MIN_VALID * window * window) & (determinant > 1e-6 * (xx + yy).square())
    safe = torch.where(enough, determinant, 1.0)
    a, b = (dx * yy - dy * xy) / safe, (dy * xx - dx * xy) / safe
    inverse_depth = torch.where(enough, d, 1.0)
    residual = (dd - a * dx - b * dy).clamp(min=0).sqrt()

    coefficients = torch.stack([a, b, inverse_depth - a * x - b * y], -1)
    length = coefficients.norm(dim=-1, keepdim=True)
    normals = -coefficients / length
    points = torch.stack([x, y, torch.ones_like(x)], -1) / inverse_depth[..., None]
    cosine = 1 / (length[..., 0] * points.norm(dim=-1))
    noise = residual[enough].median() if bool(enough.any()) else residual.new_zeros(())
    limit = _MAX_ROUGHNESS * torch.maximum(noise, _FLOOR_ROUGHNESS * inverse_depth.square())
    holds = enough & (residual <= limit) & (cosine >= _MIN_COSINE) & (d > 0)
    # An error e of 1/z moves the surface by e z^2 along the ray's z, and by that over z |coefficients| along the normal.
    sigma = noise / (inverse_depth * length[..., 0]) / count.sqrt()
    return DepthPlanes(
        coefficients=coefficients,
        points=points,
        normals=normals,
        depth=torch.where(holds, 1 / inverse_depth, 0.0),
        sigma=sigma,
        first=window // 2,
        stride=stride,
        window=window,
    )


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
