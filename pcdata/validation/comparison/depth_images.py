"""What one depth image shows of its sensor: reach, noise on flat parts, holes and flying pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcdata.validation.comparison.distances import NUM_CLASSES, class_of, middle_of

_Numbers = dict[str, float]
_Image = NDArray[np.float32]

TILE = 9  # pixels a side: noise is measured about a plane through so many
_LEAST_READ = 0.8  # of a tile
_LEAST_TILES = 12  # of a class of distances
_LOOSEST = 0.06  # of the distance: more is no noise but two surfaces
_FLATTEST = 0.25  # quantile of the tiles: those with edges and bent surfaces in them lie above
_STEP = 0.03  # of the depth: neighbors farther apart are two surfaces, as in Kinect-like sensors up to some metres
_SIGMAS = 6.0  # by which noise alone hardly sets neighbors apart
_STEEP = 3.0**0.5  # slope of a surface at 60 degrees, which a hole may lie in without an edge
_BAND = 64  # pixels of a hole at the border of the image that make it a band rather than a lost reading
_LEAST_SHARE = 0.02  # of the image: a class of distances with fewer pixels tells no share of holes
_MOST_READ = 1 << 16  # readings that tell quantiles


def measure_depth(depth: _Image, focal: float) -> _Numbers:
    """Return the numbers of a depth image (H, W) in metres, 0 = no reading; ``name@class`` of a class of distances."""
    values = depth[depth > 0]
    if not len(values):
        return {"holes": 1.0}
    some = values[:: max(1, len(values) // _MOST_READ)]
    low, near, median, far, high = np.quantile(some, [0.001, 0.02, 0.5, 0.98, 0.999]).tolist()
    counts = np.bincount(class_of(values), minlength=NUM_CLASSES)
    noise = noise_of_tiles(depth)
    return {
        **{"nearest": low, "near": near, "median": median, "far": far, "farthest": high},
        **{f"share@{k}": float(counts[k]) / depth.size for k in np.flatnonzero(counts).tolist()},
        "flying": _flying(depth, noise),
        **noise,
        **_holes(depth, focal, noise, counts),
    }


def noise_of_tiles(depth: _Image) -> _Numbers:
    """Return ``noise@class``: standard deviations in metres about planes through 9 x 9 pixels, the flattest quarter.

    One over the depth of a plane is linear in the pixels, however it is tilted.
    """
    rows, columns = depth.shape[0] // TILE, depth.shape[1] // TILE
    cut = depth[: rows * TILE, : columns * TILE].reshape(rows, TILE, columns, TILE)
    tiles = cut.swapaxes(1, 2).reshape(-1, TILE * TILE)
    read = tiles > 0
    tiles, read = (one[read.sum(1) >= _LEAST_READ * TILE * TILE] for one in (tiles, read))
    if not len(tiles):
        return {}
    side = np.linspace(-1, 1, TILE)
    design = np.stack([np.ones(TILE * TILE), np.tile(side, TILE), np.repeat(side, TILE)], 1)
    weight = read.astype(np.float64)
    inverse = np.divide(1.0, tiles, out=np.zeros_like(weight), where=read)
    products = (weight @ (design[:, :, None] * design[:, None]).reshape(-1, 9)).reshape(-1, 3, 3)
    plane = np.linalg.solve(products, (inverse @ design)[..., None])[..., 0]
    off = (inverse - plane @ design.T) * weight
    distance = 1 / np.maximum(plane[:, 0], 1e-9)
    sigma = np.sqrt((off**2).sum(1) / (weight.sum(1) - 3)) * distance**2
    one_surface = sigma < _LOOSEST * distance
    return by_class("noise", distance[one_surface], sigma[one_surface], _LEAST_TILES, _FLATTEST)


def by_class(
    name: str, distance: NDArray[np.floating], values: NDArray[np.floating], least: int, quantile: float
) -> _Numbers:
    """Return a quantile of values for every class of distances that has enough of them."""
    number = class_of(distance)
    return {
        f"{name}@{k}": float(np.quantile(values[number == k], quantile))
        for k in range(NUM_CLASSES)
        if (number == k).sum() >= least
    }


def _flying(depth: _Image, noise: _Numbers) -> float:
    """Return the share of the readings that no neighbor in their row or column lies on one surface with."""
    padded = np.pad(depth, 1)
    nearest = np.full(depth.shape, np.inf, dtype=np.float32)
    for rows, columns in ((0, 1), (2, 1), (1, 0), (1, 2)):
        other = padded[rows : rows + depth.shape[0], columns : columns + depth.shape[1]]
        nearest = np.minimum(nearest, np.where(other > 0, np.abs(other - depth), np.inf))
    read = depth > 0
    alone = read & (nearest > _step(depth, noise)) & np.isfinite(nearest)
    return float(alone.sum()) / max(int(read.sum()), 1)


def _step(depth: NDArray[np.floating], noise: _Numbers) -> NDArray[np.floating]:
    """Return by how much neighbors at these depths must differ to be two surfaces."""
    known = sorted((middle_of(int(name[6:])), value) for name, value in noise.items())
    if not known:
        return _STEP * depth
    far, most = known[-1]
    away, sigma = zip(*known, (4 * far, 16 * most))  # beyond, as the noise of triangulation grows
    return np.maximum(_STEP * depth, _SIGMAS * np.interp(depth, away, sigma))


def _holes(depth: _Image, focal: float, noise: _Numbers, counts: NDArray[np.int64]) -> _Numbers:
    """Return shares of the image without a reading: by place, by distance of what is around; and how wide holes are."""
    from scipy.ndimage import label

    hole = depth == 0
    numbers, many = label(hole, structure=np.ones((3, 3)))
    found = {"holes": float(hole.mean()), "holes_edges": 0.0, "holes_inside": 0.0, "holes_border": 0.0}
    if not many:
        return {**found, **{f"holes@{k}": 0.0 for k in np.flatnonzero(counts >= _LEAST_SHARE * depth.size).tolist()}}
    sizes = np.bincount(numbers.ravel(), minlength=many + 1)
    low, high = _rims(depth, hole, numbers, many)
    frame = np.concatenate([numbers[0], numbers[-1], numbers[:, 0], numbers[:, -1]])
    border = np.zeros(many + 1, dtype=bool)
    border[frame] = True
    border &= sizes >= _BAND
    known = np.isfinite(low)
    flat = np.where(known, low, 1.0)
    step = _step(flat, noise) + _STEEP * flat / focal * 2 * np.sqrt(sizes)
    edge = known & (high - flat > step) & ~border
    border[0] = edge[0] = False
    inside = ~edge & ~border
    inside[0] = False
    for name, chosen in (("edges", edge), ("inside", inside), ("border", border)):
        found[f"holes_{name}"] = float(sizes[chosen].sum()) / depth.size
    width = np.sqrt(sizes[1:])
    order = np.argsort(width)
    total = np.cumsum(sizes[1:][order])
    found["hole_width"] = float(width[order][np.searchsorted(total, total[-1] / 2)])
    away = known & ~border
    away[0] = False
    lost = np.bincount(class_of((flat + np.where(known, high, 1.0)) / 2)[away], sizes[away], minlength=NUM_CLASSES)
    for k in np.flatnonzero(counts + lost >= _LEAST_SHARE * depth.size).tolist():
        found[f"holes@{k}"] = float(lost[k] / (lost[k] + counts[k]))
    return found


def _rims(
    depth: _Image, hole: NDArray[np.bool_], numbers: NDArray[np.int32], many: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the least and the largest depth beside every hole; infinite where nothing is read around."""
    low, high = np.full(many + 1, np.inf), np.full(many + 1, -np.inf)
    for axis in (0, 1):
        for there, here in ((slice(1, None), slice(None, -1)), (slice(None, -1), slice(1, None))):
            at = (here, slice(None)) if axis == 0 else (slice(None), here)
            beside = (there, slice(None)) if axis == 0 else (slice(None), there)
            rim = hole[at] & ~hole[beside]
            np.minimum.at(low, numbers[at][rim], depth[beside][rim])
            np.maximum.at(high, numbers[at][rim], depth[beside][rim])
    return low, high
