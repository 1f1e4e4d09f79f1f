"""Is depth z, or a length along the rays? The largest plane of one image tells: read wrongly, it is bent.

With rays r = (x, y, 1) of length L, a plane n . r = c / z makes 1/z an affine function of x and y, whatever its tilt.
Of lengths along the rays (z L) it is L/depth that is affine, and of z that was divided by L it is 1/(depth L). So what
depth is, is the power of L that makes a plane affine: 0 = z, 1 = along the rays, -1 = z divided by L. Each of the three
is tried, the plane with the most readings is taken, and in it the power is measured, with its error: it must come out
as one of the three, and no other bend with it, since a surface that is curved by itself bends anyhow.
"""

from __future__ import annotations

from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.geometry.lens import undistort_normalized
from pcdata.rng import seeded
from pcdata.structures import DepthFrame
from pcdata.threads import in_threads

POWERS = (0, 1, -1)
LEAST_SHARE = 0.1  # of the readings: of smaller planes nothing is said
MOST_SPREAD = 1.35  # cuts through piles and curved surfaces have 1.4 and more
_READINGS = 3000  # looked at: the bend is then known to 0.05 where noise is a quarter of it
_LEAST_READINGS = 150
_TRIES = 160  # planes through three readings: of a plane with 3 of 10 readings one in 37 has all its readings there
_SCORED = 8  # of so many readings one says which of these planes is the best
_ROUNDS = 3  # of fitting it to all that lie in it
_SIGMAS = 3.0
_OFF_PLANE = (0.004, 0.02)  # least and most that readings of a plane lie off it, relative to the distance
_BLOCKS = 4  # of the image along each side, each left out once
_LEAST_BLOCKS = 4

_Array = NDArray[np.float64]


class PlaneBend(NamedTuple):
    """The largest plane of an image, and how it is bent; all but the power and its like relative to the distance."""

    power: float  # of the rays' lengths that makes it plane: 0 = depth is z, 1 = along the rays, -1 = divided
    error: float  # of the power, one standard deviation, as the parts of the plane differ
    other: float  # bend that is not around the optical axis, as a power
    share: float  # of the image's readings that lie in it
    gain: float  # times as many as in the largest plane of depth as given
    spread: float  # readings within twice the limits of the plane / within them: 1 of planes, more of curved surfaces
    noise: float  # of its readings
    bulge: float  # by which it is bent where depth is off by one power, root mean square
    plane: tuple[float, float, float]  # n with n . p = 1 for its points p (metres, camera frame), as depth is given
    middle: tuple[float, float, float]  # metres, the median of its readings in the camera's frame


class _Readings(NamedTuple):
    """Some readings of one image."""

    design: _Array  # (N, 3) 1, x, y on the plane z = 1
    inverse: _Array  # (N,) 1 / depth
    log_length: _Array  # (N,) logarithm of the ray's length
    block: NDArray[np.int64]  # (N,) part of the image
    noise: float  # relative to the distance, from neighbors alone


_known: WeakKeyDictionary[DepthFrame, list[PlaneBend | None]] = WeakKeyDictionary()


def plane_bends(frame: DepthFrame) -> list[PlaneBend | None]:
    """Return the largest plane of every view, measured once while the frame lives; None where there is none."""
    if frame not in _known:
        lens = frame.camera.distortion
        _known[frame] = in_threads(
            lambda view: plane_bend(
                frame.depth[view], frame.camera.intrinsics[view], None if lens is None else lens[view]
            ),
            range(frame.num_views),
        )
    return _known[frame]


def plane_bend(
    depth: Tensor,  # (H, W) metres, 0 = no reading
    intrinsics: Tensor,  # (3, 3) pixels
    distortion: Tensor | None,  # (D,)
) -> PlaneBend | None:
    """Measure how the largest plane is bent; None where too few readings lie in one."""
    readings = _some_readings(depth, intrinsics, distortion)
    if readings is None:
        return None
    off_plane = float(np.clip(_SIGMAS * readings.noise, *_OFF_PLANE))
    values = {power: readings.inverse * np.exp(power * readings.log_length) for power in POWERS}
    inside = {power: _largest_plane(readings.design, values[power], off_plane) for power in POWERS}
    counts = {power: int(members.sum()) for power, members in inside.items()}
    best = max(POWERS, key=lambda power: counts[power])  # of equals the first: z
    members = inside[best]
    if counts[best] < _LEAST_READINGS:
        return None
    bend = _bend(readings.design[members], values[best][members], readings.log_length[members], readings.block[members])
    slope = _fitted(readings.design[members] / readings.inverse[members][:, None])
    z = 1 / np.median(readings.inverse[members])
    across = np.median(readings.design[members], axis=0)
    return bend._replace(
        plane=(float(slope[1]), float(slope[2]), float(slope[0])),
        middle=(float(z * across[1]), float(z * across[2]), float(z)),
        power=best + bend.power,
        share=counts[best] / len(members),
        gain=counts[best] / max(counts[0], 1),
        spread=_spread(readings.design, values[best], members, off_plane),
    )


def _some_readings(depth: Tensor, intrinsics: Tensor, distortion: Tensor | None) -> _Readings | None:
    """Take readings on a grid; None where there are too few."""
    image = depth.detach().cpu().numpy()
    height, width = image.shape
    step = max(1, int((image.size / _READINGS) ** 0.5))
    grid = np.meshgrid(*(np.arange(step // 2, size, step) for size in image.shape), indexing="ij")
    rows, columns = (part.ravel() for part in grid)
    valid = image[rows, columns] > 0
    rows, columns = rows[valid], columns[valid]
    if len(rows) < _LEAST_READINGS:
        return None
    k = intrinsics.detach().cpu().numpy().astype(np.float64)
    xy = np.column_stack([(columns - k[0, 2]) / k[0, 0], (rows - k[1, 2]) / k[1, 1]])
    if distortion is not None:
        lens = distortion.detach().cpu().double()
        xy = undistort_normalized(torch.from_numpy(xy)[None], lens[None])[0].numpy()
        seen = np.isfinite(xy).all(1)
        rows, columns, xy = rows[seen], columns[seen], xy[seen]
        if len(rows) < _LEAST_READINGS:
            return None
    return _Readings(
        design=np.column_stack([np.ones(len(xy)), xy]),
        inverse=1 / image[rows, columns].astype(np.float64),
        log_length=0.5 * np.log1p((xy**2).sum(1)),
        block=(rows * _BLOCKS // height) * _BLOCKS + columns * _BLOCKS // width,
        noise=_noise(image, rows, columns),
    )


def _noise(image: NDArray[np.float32], rows: NDArray[np.int64], columns: NDArray[np.int64]) -> float:
    """Return the noise of readings relative to their distance: second differences, which planes of any tilt have not.

    Over one pixel and over three, since the readings of stereo cameras are alike in small patches.
    """
    found = [0.0]
    for down, right in ((0, 1), (1, 0), (0, 3), (3, 0)):
        inner = (rows >= down) & (rows < image.shape[0] - down) & (columns >= right)
        inner &= columns < image.shape[1] - right
        r, c = rows[inner], columns[inner]
        before, at, after = image[r - down, c - right], image[r, c], image[r + down, c + right]
        both = (before > 0) & (after > 0)
        if both.any():
            second = np.abs(before.astype(np.float64) + after - 2.0 * at)[both] / at[both]
            found.append(float(np.median(second)) / 0.6745 / 6**0.5)
    return max(found)


def _largest_plane(design: _Array, values: _Array, off_plane: float) -> NDArray[np.bool_]:
    """Return which readings lie in the plane that has the most, of planes through three; the same ones every time."""
    draw = torch.randint(len(values), (_TRIES, 3), generator=seeded(0), dtype=torch.int64, device="cpu")
    triples = draw.numpy()
    three = design[triples]
    wide = np.abs(np.linalg.det(three)) > 1e-6
    planes = np.linalg.solve(three[wide], values[triples[wide]][..., None])[..., 0]  # (T, 3)
    off = np.abs(planes @ design[::_SCORED].T / values[::_SCORED] - 1)
    if not len(off):
        return np.zeros(len(values), dtype=bool)
    plane = planes[np.argmax((off < off_plane).sum(1))]
    relative = design / values[:, None]
    inside: NDArray[np.bool_] = np.abs(relative @ plane - 1) < off_plane
    for _ in range(_ROUNDS):
        plane = _fitted(relative[inside])
        refined = np.abs(relative @ plane - 1) < off_plane
        if refined.sum() <= inside.sum():
            break
        inside = refined
    return inside


def _spread(design: _Array, values: _Array, inside: NDArray[np.bool_], off_plane: float) -> float:
    """Return how many times as many readings lie within twice the limits of a plane; a cut through a pile has twice."""
    relative = design / values[:, None]
    off = np.abs(relative @ _fitted(relative[inside]) - 1)
    return float((off < 2 * off_plane).sum() / max((off < off_plane).sum(), 1))


def _fitted(terms: _Array) -> _Array:  # (N, P) -> (P,)
    """Return the weights of terms whose sum is closest to 1."""
    return _solved(terms.T @ terms, terms.sum(0))


def _solved(products: _Array, sums: _Array) -> _Array:  # (..., P, P), (..., P) -> (..., P)
    """Solve normal equations; readings on one line leave them singular, and the solution small."""
    scale = 1 / np.sqrt(np.maximum(np.diagonal(products, axis1=-2, axis2=-1), 1e-300))
    normal = products * scale[..., :, None] * scale[..., None, :] + 1e-12 * np.eye(products.shape[-1])
    solution: _Array = scale * np.linalg.solve(normal, (scale * sums)[..., None])[..., 0]
    return solution


def _bend(design: _Array, values: _Array, log_length: _Array, block: NDArray[np.int64]) -> PlaneBend:
    """Measure how values differ from affine: by a power of L, or by the two other quadratic terms."""
    x, y = design[:, 1], design[:, 2]
    plane = design / values[:, None]
    near_one = plane @ _fitted(plane)
    terms = np.column_stack([plane, -log_length * near_one, 0.5 * (x**2 - y**2) * near_one, x * y * near_one])
    products, sums = terms.T @ terms, terms.sum(0)
    weights = _solved(products, sums)
    parts = [terms[block == number] for number in np.unique(block)]
    without = np.stack([products - part.T @ part for part in parts]), np.stack([sums - part.sum(0) for part in parts])
    left_out = _solved(*without)[:, 3]
    others = terms[:, [0, 1, 2, 4, 5]]
    bulge = terms[:, 3] - others @ _solved(others.T @ others, others.T @ terms[:, 3])
    jackknife = (len(left_out) - 1) ** 0.5 * float(left_out.std())
    return PlaneBend(
        power=float(weights[3]),
        error=jackknife if len(left_out) >= _LEAST_BLOCKS else float("inf"),
        other=float(np.hypot(weights[4], weights[5])),
        share=1.0,
        gain=1.0,
        spread=1.0,
        noise=float(np.median(np.abs(terms @ weights - 1))) / 0.6745,
        bulge=float(np.sqrt((bulge**2).mean())),
        plane=(0.0, 0.0, 0.0),
        middle=(0.0, 0.0, 0.0),
    )
