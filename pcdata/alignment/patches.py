"""Small curved patches fitted to the windows of a depth image: surface points and normals, the noise averaged out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
    images = _Images.of(depth)
    taken = _fit(images, _Windows(size, halves[0], first, stride))
    holds = taken.holds
    floor = _FLOOR_ROUGHNESS * taken.coefficients[0].square()
    noise = taken.variance[holds].median().sqrt() if bool(holds.any()) else floor.new_zeros(())
    allowed = torch.maximum(noise, floor).square()
    holds = holds & (taken.variance <= _MAX_ROUGHNESS**2 * allowed)
    half = torch.where(holds, halves[0], 0)
    for wider in halves[1:]:
        fit = _fit(images, _Windows(size, wider, first, stride))
        freedom = (fit.pixels - 6).clamp(min=1)
        good = fit.holds & holds & (fit.variance <= allowed * (1 + _MAX_EXCESS * (2 / freedom).sqrt()))
        taken = _Fit(*(torch.where(good, new, old) for old, new in zip(taken, fit)))
        half = torch.where(good, wider, half)
    coefficients = taken.coefficients.permute(1, 2, 0).contiguous()
    inverse_depth = coefficients[..., 0]
    holds = holds & (inverse_depth > 0)
    safe = torch.where(holds, inverse_depth, 1.0)
    normals = patch_normals(coefficients[..., :3], rays, steps)
    cosine = -(normals * rays).sum(-1)  # times the ray's length
    holds = holds & torch.isfinite(cosine) & (cosine >= MIN_COSINE * rays.norm(dim=-1))
    # An error e of 1/z moves the surface by e / (1/z)^2 along the ray, and by the cosine of that along its normal.
    sigma = noise * cosine / safe.square() / stride
    return DepthPatches(
        coefficients=coefficients,
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


class _Images(NamedTuple):
    """What is summed over windows; (H, W) float64 each, 0 where there is no reading."""

    read: Tensor  # 1 = a reading
    inverse: Tensor  # 1/z
    square: Tensor  # of that

    @classmethod
    def of(cls, depth: Tensor) -> _Images:
        inverse = torch.where(depth > 0, 1 / torch.where(depth > 0, depth, 1.0).double(), 0.0)
        return cls((depth > 0).double(), inverse, inverse.square())


class _Fit(NamedTuple):
    """Least squares of every window of one width."""

    coefficients: Tensor  # (6, h, w)
    variance: Tensor  # (h, w) of 1/z about the patch
    slope_spread: Tensor  # (h, w) standard deviation of the steeper of b and c for pixels of unit variance
    pixels: Tensor  # (h, w) that have a reading
    holds: Tensor  # (h, w) bool, enough pixels


def _fit(images: _Images, windows: _Windows) -> _Fit:
    """Fit the windows; pixels beyond the image have no reading."""
    moments = [windows.down(one, degree=4 - u) for u, one in enumerate(windows.across(images.read, degree=4))]
    along_u = windows.across(images.inverse, degree=2)
    by_power = [windows.down(one, degree=2 - u) for u, one in enumerate(along_u)]
    (square,) = windows.down(windows.across(images.square, degree=0)[0], degree=0)
    right = [by_power[u][v] for u, v in _POWERS]
    normal = [[moments[u + a][v + b] for a, b in _POWERS[: row + 1]] for row, (u, v) in enumerate(_POWERS)]
    solution, solved = _solve(normal, right)
    count, half = moments[0][0], windows.half
    residual = square
    for one, other in zip(solution, right):
        residual = torch.addcmul(residual, one, other, value=-1)
    # The moments were taken over offsets in half windows, so that high powers stay near 1.
    return _Fit(
        torch.stack([one * half ** -(u + v) for one, (u, v) in zip(solution, _POWERS)]),
        residual.clamp(min=0) / (count - 6).clamp(min=1),
        torch.minimum(normal[1][1], normal[2][2]).clamp(min=1e-12).rsqrt() / half,
        count,
        solved & (count >= _MIN_VALID * (2 * half + 1) ** 2),
    )


def _solve(normal: Sequence[Sequence[Tensor]], right: Sequence[Tensor]) -> tuple[list[Tensor], Tensor]:
    """Solve normal equations, one of each pixel of the images that are their entries: the lower triangle, by rows.

    Returns the unknowns, and where the equations determine them.

    Source: Golub & Van Loan, Matrix Computations, 4th ed., section 4.1.2: L D L^T.
    """
    lower: list[list[Tensor]] = []  # L[i][k] for k < i
    pivots: list[Tensor] = []
    solved = torch.ones_like(right[0], dtype=torch.bool)
    for row in normal:
        left: list[Tensor] = []
        scaled: list[Tensor] = []  # L[i][k] D[k]
        for k, entry in enumerate(row[:-1]):
            for inner, other in zip(scaled, lower[k]):
                entry = torch.addcmul(entry, inner, other, value=-1)
            scaled.append(entry)
            left.append(entry / pivots[k])
        pivot = row[-1]
        for one, other in zip(left, scaled):
            pivot = torch.addcmul(pivot, one, other, value=-1)
        solved = solved & (pivot > 0)
        pivots.append(torch.where(solved, pivot, 1.0))
        lower.append(left)
    found: list[Tensor] = []
    for i, one in enumerate(right):
        for k in range(i):
            one = torch.addcmul(one, lower[i][k], found[k], value=-1)
        found.append(one)
    found = [one / pivot for one, pivot in zip(found, pivots)]
    for i in reversed(range(len(found))):
        for k in range(i + 1, len(found)):
            found[i] = torch.addcmul(found[i], lower[k][i], found[k], value=-1)
    return found, solved


class _Windows:
    """Sums over square windows on a grid, weighted by powers of the offset from the center, in half windows.

    The two pixels at one distance from the center are added for even powers and subtracted for odd ones, so that each
    sum is a few additions of whole images.
    """

    def __init__(self, size: tuple[int, int], half: int, first: int, stride: int) -> None:
        self.half, self._first, self._stride = half, first, stride
        self._counts = [len(range(first, length - first, stride)) for length in size]

    def across(self, image: Tensor, *, degree: int) -> list[Tensor]:
        """Sum along rows: (H, w) for the powers 0 to ``degree``."""
        padded = torch.nn.functional.pad(image, (self.half, self.half))
        # Pixels of one phase of the stride lie side by side: what is added is contiguous.
        phases = [padded[:, phase :: self._stride].contiguous() for phase in range(self._stride)]

        def at(offset: int) -> Tensor:
            step, phase = divmod(self._first + self.half + offset, self._stride)
            return phases[phase][:, step : step + self._counts[1]]

        return self._sums(at, degree)

    def down(self, image: Tensor, *, degree: int) -> list[Tensor]:
        """Sum along columns: (h, w) of an image (H, w) for the powers 0 to ``degree``."""
        padded = torch.nn.functional.pad(image, (0, 0, self.half, self.half))

        def at(offset: int) -> Tensor:
            return padded[self._first + self.half + offset :: self._stride][: self._counts[0]]

        return self._sums(at, degree)

    def _sums(self, at: Callable[[int], Tensor], degree: int) -> list[Tensor]:
        sums = [at(0).clone(), *(torch.zeros_like(at(0)) for _ in range(degree))]
        for distance in range(1, self.half + 1):
            before, after = at(-distance), at(distance)
            both = before + after
            sums[0] += both
            if degree:
                apart = after - before
                for power in range(1, degree + 1):
                    sums[power].add_(apart if power % 2 else both, alpha=(distance / self.half) ** power)
        return sums


def _rays_at_centers(
    intrinsics: Tensor, size: tuple[int, int], distortion: Tensor | None, first: int, stride: int
) -> tuple[Tensor, Tensor]:
    """Return the rays (h, w, 3) of the windows' centers and how they change from pixel to pixel (h, w, 2, 2)."""
    rays = pixel_rays(intrinsics[None].double(), size, None if distortion is None else distortion[None].double())[0]
    at, before, after = (
        [slice(first + step, max(length - first, first) + step, stride) for length in size] for step in (0, -1, 1)
    )
    by_u = (rays[at[0], after[1]] - rays[at[0], before[1]]) / 2
    by_v = (rays[after[0], at[1]] - rays[before[0], at[1]]) / 2
    return torch.nn.functional.pad(rays[at[0], at[1]], (0, 1), value=1.0), torch.stack([by_u, by_v], -2)
