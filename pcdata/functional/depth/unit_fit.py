"""Which unit can stored depth be in? Every usual one is tried against what its scale would have to look like.

A depth image does not show its scale, but it leaves traces: how far the scene would be, how noisy the sensor at that
distance, how coarse its disparity steps, in which steps the numbers come, and whether the image is smooth once the bits
are put in order. Each unit gets the probability that these give it, and the caller sees all that fit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import UnitError

DepthEncoding = Literal["plain", "rotated", "swapped"]
DEPTH_ENCODINGS: tuple[DepthEncoding, ...] = ("plain", "rotated", "swapped")


class DepthUnit(NamedTuple):
    """How a stored number becomes metres."""

    metres: float  # of one unit, once the bits are in order
    encoding: DepthEncoding = "plain"

    def __str__(self) -> str:
        """The options of a source that say so."""
        order = "" if self.encoding == "plain" else f", depth_encoding={self.encoding}"
        return f"metres_per_unit={self.metres:.10g}{order}"

    @property
    def flags(self) -> str:
        """The options of the command line that say so."""
        order = "" if self.encoding == "plain" else f" --depth-encoding {self.encoding}"
        return f"--metres-per-unit {self.metres:.10g}{order}"


class UnitFit(NamedTuple):
    """One unit that stored depth may be in."""

    unit: DepthUnit
    probability: float  # of all units tried
    median: float  # metres: half of the readings would lie within


# Logarithms of how usual each unit is. Millimetres are the convention of most sensors and data sets; 0.1 and 0.25 mm
# are settings of RealSense cameras, 0.2 mm is TUM's, 1/256 m KITTI's; SUN3D and the Amazon picking sets rotate bits.
_WHOLE = {
    DepthUnit(0.001): 0.0,
    DepthUnit(0.0001): -2.7,
    DepthUnit(0.0002): -3.0,
    DepthUnit(0.00025): -3.0,
    DepthUnit(0.000125): -4.5,
    DepthUnit(1 / 256): -4.5,
    DepthUnit(0.00001): -5.5,
    DepthUnit(0.01): -5.5,
    DepthUnit(0.1): -7.0,
    DepthUnit(1.0): -6.0,
    DepthUnit(0.001, "rotated"): -3.5,
    DepthUnit(0.0001, "rotated"): -4.0,
    DepthUnit(0.001, "swapped"): -4.5,
    DepthUnit(0.0001, "swapped"): -6.5,
    DepthUnit(0.0002, "swapped"): -6.5,
}
# Fractions of a unit are metres as a rule; the others are what is left of an integer after a conversion to floats.
_FRACTIONS = {
    DepthUnit(1.0): 0.0,
    DepthUnit(0.001): -2.0,
    DepthUnit(0.01): -4.0,
    **{DepthUnit(metres): -6.0 for metres in (0.1, 10.0, 100.0, 1000.0)},
}
_UNUSUAL = -4.0  # a unit that is stated and in no list
_OTHER_THAN_KNOWN = -6.0  # a unit that the sensor is not known to have
_NEAREST = 0.01  # metres: no median lies nearer

_BLOCK = 24  # pixels: side of the squares in which roughness is measured
_BANDS = 10  # of squares, across and down: some two hundred squares tell as much as all
_SPACING = 4  # pixels between the three readings of a second difference: beyond the matching window's correlation
_SMOOTH = 0.05  # of the depth: neighbors on one surface differ by less
_LEAST_SMOOTH = 0.7  # of neighbors in any depth image; half as many where bits are out of order
_SMOOTH_ROWS = 48  # looked at
_QUANTILE = 40.0  # per cent of the blocks: the flatter half, where roughness is noise and not shape
_DIVIDED = 1 << 11  # readings
_PIXELS = 1 << 17  # looked at: shares are known to 0.4 %

# Disparity noise over baseline, sigma focal / z^2 in pixels per metre: measured on seven sensors 0.27 to 2.9, most
# within 0.65 and 1.5. Time of flight: a sigma of 1 to 3 mm, whatever the distance.
_STEREO_NOISE = (0.8, 0.55)  # center, spread of the logarithm
_FLIGHT_NOISE = (0.0015, 0.5)
_FLIGHT_RARER = -0.7
WORTH_NAMING = 0.001  # probability above which a unit is named: without the camera even the right one may look unlikely
# Disparity step over baseline, in pixels per metre: 1/32 of a pixel over 0.1 m, to 1/8 over 0.075 m and a margin.
_STEPS = (0.3, 2.0)
_STEP_SPREAD = 0.3
_LEAST_STEP = 2.5  # units: finer steps are the rounding's


def unit_fits(
    stored: NDArray[Any],  # (H, W) uint16 or float as stored, 0 = no reading
    *,
    declared: DepthUnit | None = None,
    focal: float | None = None,  # pixels; None = that of a usual lens
    workspace: tuple[float, float] = (0.2, 2.0),  # metres, where the scene is expected
    workspace_is_known: bool = False,
    known_units: Sequence[float] = (),  # metres: those that the sensor has
) -> list[UnitFit]:
    """Return every unit that was tried, the most probable first.

    Args:
        stored: the numbers as they are stored. Rows and columns must still be those of the image.
        declared: the unit that was stated; it is tried even where nobody uses it.
        focal: for the noise, which grows with the square of the distance over the focal length.
        workspace: where the scene is expected.
        workspace_is_known: whether somebody stated it for this scene: then a scene outside is another unit.
        known_units: of the sensor, where it is known.
    """
    stored = np.where(np.isfinite(stored), stored, 0)
    if not (stored > 0).any():
        return []
    is_whole = bool(stored.dtype.kind in "ui" or (np.rint(stored) == stored).all())
    tried = dict(_WHOLE if is_whole and stored.max() <= 65535 else _FRACTIONS)
    if declared is not None:
        tried.setdefault(declared, _UNUSUAL)
    focal = focal or 0.9 * stored.shape[1]
    traces = {encoding: _Traces.of(decoded(stored, encoding)) for encoding in sorted({unit.encoding for unit in tried})}
    scores = {}
    for unit, usual in tried.items():
        trace = traces[unit.encoding]
        score = usual + _distance_fits(trace.median * unit.metres, workspace, workspace_is_known)
        score += trace.fits(unit.metres, focal)
        if known_units and not any(math.isclose(unit.metres, known, rel_tol=1e-3) for known in known_units):
            score += _OTHER_THAN_KNOWN
        scores[unit] = score
    top = max(scores.values())
    weights = {unit: math.exp(score - top) for unit, score in scores.items()}
    total = sum(weights.values())
    fits = [
        UnitFit(unit, weight / total, traces[unit.encoding].median * unit.metres) for unit, weight in weights.items()
    ]
    return sorted(fits, key=lambda fit: -fit.probability)


def likely_fits(stored: NDArray[Any]) -> list[UnitFit]:
    """Return the up to four units that stored depth fits best, of those that are worth a mention; the best first."""
    return [fit for fit in unit_fits(stored) if fit.probability >= WORTH_NAMING][:4]


def check_depth_encoding(where: str, encoding: str) -> DepthEncoding:
    """Return the order of bits; it must be one that is known.

    Raises:
        UnitError: it is not.
    """
    if encoding not in DEPTH_ENCODINGS:
        raise UnitError(f"{where}: depth_encoding must be one of {', '.join(DEPTH_ENCODINGS)}, got {encoding!r}")
    return encoding


def units_in_words(fits: Sequence[UnitFit]) -> str:
    """Name units with the distance that each gives, such as ``metres_per_unit=0.001 (half within 0.62 m)``."""
    return " or ".join(f"{fit.unit} (half within {fit.median:.3g} m)" for fit in fits)


def decoded(stored: NDArray[Any], encoding: DepthEncoding) -> NDArray[Any]:
    """Put the bits of stored 16-bit numbers in order: rotated = by three to the right again, swapped = bytes."""
    if encoding == "plain":
        return stored
    bits = stored.astype(np.uint16)
    return (bits >> 3) | (bits << 13) if encoding == "rotated" else bits.byteswap()


def encoded(depth: NDArray[Any], encoding: DepthEncoding) -> NDArray[Any]:
    """Put 16-bit numbers out of order again, the inverse of :func:`decoded`."""
    if encoding == "plain":
        return depth
    bits = depth.astype(np.uint16)
    return (bits << 3) | (bits >> 13) if encoding == "rotated" else bits.byteswap()


class _Traces(NamedTuple):
    """What a scale leaves behind in an image, in units as stored."""

    median: float
    smooth: float  # share of neighbors that lie on one surface
    roughness: float | None  # sigma / z^2, in 1 / unit; None = nothing flat enough to tell
    is_rounding: bool  # the roughness is no more than that of rounding to whole units
    step: float | None  # distance of the values that occur / z^2, in 1 / unit, where it is more than rounding's
    divisor: int  # of nearly all values

    @classmethod
    def of(cls, image: NDArray[Any]) -> _Traces:
        some = image.ravel()[:: max(1, image.size // _PIXELS)]
        readings = some[some > 0].astype(np.float64)
        median = float(np.median(readings)) if len(readings) else math.nan
        smooth = _smooth_share(image[:: max(1, len(image) // _SMOOTH_ROWS)].astype(np.float64))
        if smooth < 0.5 * _LEAST_SMOOTH:  # no image: nothing else matters
            return cls(median, smooth, None, False, None, 1)
        roughness = _roughness(image)
        floor = 0.29 / median**2  # standard deviation of rounding
        is_rounding = roughness is not None and roughness < 1.5 * floor and median > 20
        divisor = _divisor(readings)
        return cls(median, smooth, roughness, is_rounding, _step(readings, divisor), divisor)

    def fits(self, metres: float, focal: float) -> float:
        """Return the logarithm of how well these traces fit a unit of this length."""
        score = 0.0 if self.smooth >= _LEAST_SMOOTH else -30.0 * (_LEAST_SMOOTH - self.smooth)
        if self.roughness is not None and self.roughness > 0 and not self.is_rounding:
            stereo = _bell(self.roughness / metres * focal, *_STEREO_NOISE)
            sigma = self.roughness * metres * self.median**2
            score += max(stereo, _bell(sigma, *_FLIGHT_NOISE) + _FLIGHT_RARER)
        if self.step is not None:
            # A disparity step is the sensor's; wider steps than any sensor's mean that the scene is farther.
            score += _band(self.step / metres * focal, *_STEPS, _STEP_SPREAD)
        if self.divisor > 1:
            # Numbers that all share a divisor were whole in a coarser unit: a round one.
            score += 0.0 if _is_round(self.divisor * metres) else -6.0
        return score


def _distance_fits(median: float, workspace: tuple[float, float], is_known: bool) -> float:
    """A camera stands no nearer than it can see; scenes beyond the workspace become rare slowly, unless it is known."""
    if not median > 0:
        return -100.0
    near, far = workspace
    if is_known:
        return max(-40.0, _band(median, near, far, 0.15))
    return max(-40.0, _band(median, 1.75 * near, 1e9, 0.2) + _band(median, 1e-12, 1.25 * far, 0.6))


def _bell(value: float, center: float, spread: float) -> float:
    return max(-12.0, -0.5 * (math.log(value / center) / spread) ** 2)


def _band(value: float, low: float, high: float, spread: float) -> float:
    """0 within the band, falling off like a bell in the logarithm outside."""
    outside = math.log(low / value) if value < low else math.log(value / high) if value > high else 0.0
    return -0.5 * (outside / spread) ** 2


def _is_round(metres: float) -> bool:
    return any(math.isclose(metres, one, rel_tol=1e-3) for one in (1e-4, 1e-3, 1e-2, 1e-1, 1.0))


def _divisor(readings: NDArray[np.float64]) -> int:
    """Return the largest of a few divisors that 95 per cent of the values share; 1 where they are no whole numbers."""
    if not len(readings) or (readings != np.rint(readings)).any():
        return 1
    whole = readings.astype(np.int64)
    some = whole[:: max(1, len(whole) // _DIVIDED)]  # enough to rule most of them out
    for by in (1000, 100, 50, 40, 20, 10, 8, 5, 4, 2):
        if (some % by == 0).mean() > 0.9 and (whole % by == 0).mean() > 0.95:
            return by
    return 1


def _step(readings: NDArray[np.float64], divisor: int) -> float | None:
    """Return the usual distance of neighboring values that occur, over the depth squared, if it is no rounding's."""
    values, counts = _counted(readings)
    values = values[counts >= max(2, len(readings) // 20_000)]
    if len(values) < 20:
        return None
    gaps, begin = np.diff(values), values[:-1]
    # Wider gaps are empty space; nearer than the middle the steps are finer, and rounding hides them.
    here = (gaps < 0.03 * begin) & (begin >= np.median(readings))
    if here.sum() < 10 or np.median(gaps[here]) < _LEAST_STEP * divisor:
        return None
    return float(np.median(gaps[here] / begin[here] ** 2))


def _counted(readings: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the values that occur, rising, and how often; whole numbers of 16 bits are counted without sorting."""
    if len(readings) and readings.max() <= 65535 and (readings == np.rint(readings)).all():
        counts = np.bincount(readings.astype(np.int64))
        values = counts.nonzero()[0]
        return values.astype(np.float64), counts[values]
    return np.unique(readings, return_counts=True)


def _smooth_share(depth: NDArray[np.float64]) -> float:
    """Return the share of neighbors that lie on one surface."""
    a, b = depth[:, :-1], depth[:, 1:]
    both = (a > 0) & (b > 0)
    if not both.any():
        return 1.0
    return float((np.abs(a - b)[both] < _SMOOTH * np.minimum(a, b)[both]).mean())


def _roughness(depth: NDArray[Any]) -> float | None:
    """Return the standard deviation of a reading over the depth squared, from second differences in flat blocks."""
    tiles = np.concatenate([_second_differences(depth), _second_differences(depth.T)])
    found = np.isfinite(tiles)
    tiles, found = tiles[enough := found.mean(1) > 0.6], found[enough]
    if len(tiles) < 8:
        return None
    ordered = np.sort(np.where(found, tiles, np.inf), axis=1)
    median = ordered[np.arange(len(tiles)), found.sum(1) // 2]
    # An edge within a block is no noise: values beyond four times the median count as four times it.
    clipped = np.minimum(np.where(found, tiles, 0.0), 4.0 * median[:, None] + 1e-12)
    return float(np.percentile(np.sqrt((clipped**2).sum(1) / found.sum(1)), _QUANTILE))


def _second_differences(depth: NDArray[Any]) -> NDArray[np.float32]:  # (T, _BLOCK * _BLOCK), NaN = not on one surface
    """Return the relative second differences along the rows in squares of some bands of rows."""
    rows = len(depth) // _BLOCK
    width = depth.shape[1] - 2 * _SPACING
    width -= width % _BLOCK
    if not rows or width <= 0:
        return np.empty((0, _BLOCK * _BLOCK), np.float32)
    bands = np.unique(np.linspace(0, rows - 1, min(rows, _BANDS)).round().astype(np.int64))
    picked = (bands[:, None] * _BLOCK + np.arange(_BLOCK)).ravel()
    band = depth[picked].astype(np.float32)  # whole numbers below 2^24 stay exact
    a, b, c = (band[:, begin : begin + width] for begin in (0, _SPACING, 2 * _SPACING))
    ok = (a > 0) & (b > 0) & (c > 0) & (np.abs(a - b) < _SMOOTH * b) & (np.abs(c - b) < _SMOOTH * b)
    relative = np.where(ok, np.abs(a - 2 * b + c), np.nan) / np.where(ok, b * b, 1.0) / math.sqrt(6.0)
    tiles = relative.reshape(len(bands), _BLOCK, width // _BLOCK, _BLOCK)
    return tiles.transpose(0, 2, 1, 3).reshape(-1, _BLOCK * _BLOCK).astype(np.float32, copy=False)
