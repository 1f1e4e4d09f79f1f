"""Small curved patches fitted to the windows of a depth image: surface points and normals, the noise averaged out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from pcdata.functional.depth.deproject import pixel_rays

# Half the widths of the windows, as tangents: 5.5, 9 and 15.5 mm at 1 m. The narrowest sees the sides of small objects,
# which alone show a camera that slid along the table; the widest has normals true enough to tell relief from noise.
_HALF_WINDOWS = (0.0055, 0.009, 0.0155)
_LEAST_HALF = 2  # pixels: five by five, which six unknowns leave something to check with
_MIN_VALID = 0.7  # of a window's pixels
_MAX_ROUGHNESS = 2.0  # times the image's median residual: narrow windows across an edge
_MAX_EXCESS = 3.0  # standard deviations by which a wider window's residual may exceed the noise
_FLOOR_ROUGHNESS = 3e-4  # metres: what a perfect sensor's surfaces are allowed
MIN_COSINE = 0.2  # between ray and normal: flatter ones are mostly noise
_POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))  # of u and v, in the order of the coefficients


@dataclass(frozen=True, eq=False)
class DepthPatches:
    """A grid of patches 1/z = a + b u + c v + d u^2 + e u v + f v^2, u and v pixels from the center of each."""

    coefficients: Tensor  # (h, w, 6) float64, 1/metre
    points: Tensor  # (h, w, 3) float64, where the ray of the window's center meets the patch
    normals: Tensor  # (h, w, 3) float64 unit, toward the camera, there
    depth: Tensor  # (h, w) float64 of the points, 0 = the window holds no patch
    sigma: Tensor  # (h, w) float64 metres along the normal, of a patch whose pixels are its own; see fit_depth_patches
    normal_sigma: Tensor  # (h, w) float64 radians, standard deviation of the normal along each tangent
    half: Tensor  # (h, w) int64 pixels from the center to the rim of the window taken, 0 = none
    ray_steps: Tensor  # (h, w, 2, 2) float64, how (x/z, y/z) changes from one pixel to the next along u, and along v
    first: int  # pixel coordinate of the first window's center, both ways
    stride: int  # pixels between centers


def fit_depth_patches(
    depth: Tensor,  # (H, W) float32 metres, 0 = no reading
    intrinsics: Tensor,  # (3, 3) pixels
    distortion: Tensor | None = None,  # (D,)
) -> DepthPatches:
    """Fit a quadratic to every window of a depth image, by least squares in inverse depth.

    On a plane 1/z is linear in the pixels, and a stereo camera's noise is uniform in it; the second order follows bent
    surfaces, on which a plane would lie inside by half the curvature times the window's variance, the more so the more
    slanted it is seen. Of windows 11, 18 and 31 mm wide at 1 m, the widest is taken whose residual is no more than the
    image's noise explains. A window holds no patch where fewer than 70 per cent of its pixels have a reading, where
    even the narrowest has a residual of more than twice the image's median (a depth edge), or where it is seen at less
    than 12 degrees.

    Windows overlap, so their patches share pixels; ``sigma`` is what a patch would have of the pixels nearer to its
    center than to any other, so that summing over patches counts every pixel once.
    """
    fx = float(intrinsics[0, 0])
    halves = sorted({max(_LEAST_HALF, round(tangent * fx)) for tangent in _HALF_WINDOWS})
    first = stride = halves[0]
    size = (depth.shape[0], depth.shape[1])
    rays, steps = _rays_at_centers(intrinsics, size, distortion, first, stride)
    taken = _fit(depth, halves[0], first, stride)
    holds = taken.holds
    floor = _FLOOR_ROUGHNESS * taken.coefficients[..., 0].square()
    noise = taken.variance[holds].median().sqrt() if bool(holds.any()) else floor.new_zeros(())
    allowed = torch.maximum(noise, floor).square()
    holds = holds & (taken.variance <= _MAX_ROUGHNESS**2 * allowed)
    half = torch.where(holds, halves[0], 0)
    for wider in halves[1:]:
        fit = _fit(depth, wider, first, stride)
        freedom = (fit.pixels - 6).clamp(min=1)
        good = fit.holds & holds & (fit.variance <= allowed * (1 + _MAX_EXCESS * (2 / freedom).sqrt()))
        taken = _Fit(
            *(torch.where(good.reshape(good.shape + (1,) * (old.ndim - 2)), new, old) for old, new in zip(taken, fit))
        )
        half = torch.where(good, wider, half)
    inverse_depth = taken.coefficients[..., 0]
    holds = holds & (inverse_depth > 0)
    safe = torch.where(holds, inverse_depth, 1.0)
    normals = patch_normals(taken.coefficients[..., :3], rays, steps)
    cosine = -(normals * rays).sum(-1)  # times the ray's length
    holds = holds & torch.isfinite(cosine) & (cosine >= MIN_COSINE * rays.norm(dim=-1))
    # An error e of 1/z moves the surface by e / (1/z)^2 along the ray, and by the cosine of that along its normal.
    sigma = noise * cosine / safe.square() / stride
    return DepthPatches(
        coefficients=taken.coefficients,
        points=rays / safe[..., None],
        normals=normals,
        depth=torch.where(holds, 1 / safe, 0.0),
        sigma=torch.where(holds, sigma, 0.0),
        # Along the tangent that is not foreshortened; along the other it is smaller.
        normal_sigma=torch.where(holds, noise * taken.slope_spread * fx * cosine / safe, 0.0),
        half=torch.where(holds, half, 0),
        ray_steps=steps,
        first=first,
        stride=stride,
    )


def patch_normals(
    plane: Tensor,  # (..., 3) float64: 1/z, and its derivatives by u and v
    rays: Tensor,  # (..., 3) float64: x/z, y/z, 1
    ray_steps: Tensor,  # (..., 2, 2) float64: the derivatives of x/z and y/z by u, and by v
) -> Tensor:  # (..., 3) float64 unit, toward the camera
    """Return the normals of surfaces X = ray / d from d and its derivatives: the cross product of dX/du and dX/dv."""
    d, by_u, by_v = plane[..., None].unbind(-2)
    along_u, along_v = torch.nn.functional.pad(ray_steps, (0, 1)).unbind(-2)
    tangents = along_u * d - rays * by_u, along_v * d - rays * by_v
    return torch.nn.functional.normalize(torch.linalg.cross(tangents[1], tangents[0]), dim=-1)


class _Fit(NamedTuple):
    """Least squares of every window of one width."""

    coefficients: Tensor  # (h, w, 6)
    variance: Tensor  # (h, w) of 1/z about the patch
    slope_spread: Tensor  # (h, w) standard deviation of the steeper of b and c for pixels of unit variance
    pixels: Tensor  # (h, w) that have a reading
    holds: Tensor  # (h, w) bool, enough pixels


def _fit(depth: Tensor, half: int, first: int, stride: int) -> _Fit:
    """Fit the windows that reach ``half`` pixels from their centers; pixels beyond the image have no reading."""
    valid = (depth > 0).double()
    inverse = torch.where(depth > 0, 1 / torch.where(depth > 0, depth, 1.0).double(), 0.0)
    weight = _window_moments(valid, half, first, stride, 4)
    moment = _window_moments(inverse, half, first, stride, 2)
    square = _window_moments(inverse.square(), half, first, stride, 0)[..., 0, 0]
    # Moment (v, u) of degree 4 and of degree 2, in the order of the unknowns.
    pairs = torch.tensor(
        [[5 * (v + b) + u + a for a, b in _POWERS] for u, v in _POWERS], dtype=torch.int64, device=depth.device
    )
    singles = torch.tensor([3 * v + u for u, v in _POWERS], dtype=torch.int64, device=depth.device)
    normal = weight.flatten(-2)[..., pairs.flatten()].unflatten(-1, (6, 6))
    right = moment.flatten(-2)[..., singles]
    count = normal[..., 0, 0]
    holds = count >= _MIN_VALID * (2 * half + 1) ** 2
    one = torch.eye(6, dtype=torch.float64, device=depth.device)
    factor, failed = torch.linalg.cholesky_ex(torch.where(holds[..., None, None], normal, one))
    holds = holds & (failed == 0)
    factor = torch.where(holds[..., None, None], factor, one)
    solution = torch.cholesky_solve(right[..., None], factor)[..., 0]
    residual = (square - (solution * right).sum(-1)).clamp(min=0)
    # The moments were taken over offsets in half windows, so that high powers stay near 1.
    scale = solution.new_tensor([half ** -(u + v) for u, v in _POWERS])
    slope = torch.minimum(normal[..., 1, 1], normal[..., 2, 2]).clamp(min=1e-12).rsqrt() / half
    return _Fit(solution * scale, residual / (count - 6).clamp(min=1), slope, count, holds)


def _window_moments(image: Tensor, half: int, first: int, stride: int, degree: int) -> Tensor:
    """Sum image * v^i u^j over each window, i, j = 0 to degree: (h, w, degree + 1, degree + 1), in half windows."""
    offset = torch.arange(-half, half + 1, dtype=torch.float64, device=image.device) / half
    powers = offset[:, None] ** torch.arange(degree + 1, dtype=torch.int64, device=image.device)
    height, width = image.shape
    if height <= 2 * first or width <= 2 * first:
        down, across = (len(range(first, length - first, stride)) for length in (height, width))
        return image.new_zeros(down, across, degree + 1, degree + 1)
    # Row i of the padded image is row i - half of the image: the window about center c starts at row c.
    padded = torch.nn.functional.pad(image, (half,) * 4)[
        first : height - first + 2 * half, first : width - first + 2 * half
    ]
    along_u = padded.unfold(1, 2 * half + 1, stride) @ powers
    return (along_u.unfold(0, 2 * half + 1, stride) @ powers).transpose(-1, -2)


def _rays_at_centers(
    intrinsics: Tensor, size: tuple[int, int], distortion: Tensor | None, first: int, stride: int
) -> tuple[Tensor, Tensor]:
    """Return the rays (h, w, 3) of the windows' centers and how they change from pixel to pixel (h, w, 2, 2)."""
    rays = pixel_rays(intrinsics[None].double(), size, None if distortion is None else distortion[None].double())[0]
    rows, columns = (slice(first, max(length - first, first), stride) for length in size)
    by_v, by_u = torch.gradient(rays, dim=(0, 1)) if min(size) > 1 else (torch.zeros_like(rays),) * 2
    steps = torch.stack([by_u[rows, columns], by_v[rows, columns]], -2)
    return torch.nn.functional.pad(rays[rows, columns], (0, 1), value=1.0), steps
