"""Depth as sensors store it -> metres: whole numbers or floats of a stated unit, with marks for "no reading"."""

from __future__ import annotations

import warnings
from collections.abc import Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.contracts.lengths import check_metres_per_unit, ways
from pcdata.errors import CaptureError, DTypeError, NoReadingError, PcdataWarning, UnitError
from pcdata.functional.depth.unit_fit import WORTH_NAMING, DepthEncoding, DepthUnit, decoded, unit_fits, units_in_words

_NEAREST, _FARTHEST = 0.01, 100.0  # metres: no median of a depth camera's frame lies outside
MARKS = {65535: "the highest 16-bit number", 32767: "the highest 15-bit number", 4095: "the highest 12-bit number"}
_FEW = 1000  # fewer readings may hold any number by chance
_MARKED = 0.002  # of the readings: a single depth holds less of any real scene
_SAMPLE = 1 << 16  # pixels that tell as much as all


def metres_of_value(metres_per_unit: float, encoding: DepthEncoding = "plain") -> NDArray[np.float32]:
    """Return the nearest float32 metres of each of the 65536 stored values."""
    units = decoded(np.arange(1 << 16, dtype=np.uint32).astype(np.uint16), encoding)
    return (units.astype(np.float64) * metres_per_unit).astype(np.float32)


def metres_of_numbers(
    stored: NDArray[np.uint16], metres_per_unit: float, invalid: Collection[int]
) -> NDArray[np.float32]:
    """Return the metres of each number as :func:`metres_of_value` has them, 0 for those that mean "no reading".

    It takes a third of the time of looking them up.
    """
    depth = np.empty(stored.shape, np.float32)
    np.multiply(stored, metres_per_unit, out=depth, dtype=np.float64, casting="same_kind")
    for mark in invalid:
        depth[stored == mark] = 0.0
    return depth


def clean_float_depth(where: str, raw: NDArray[Any], unit: float, invalid: Collection[int]) -> NDArray[np.float32]:
    """Return float depth in metres, NaN and infinite numbers and those that mark no reading as 0.

    Raises:
        CaptureError: negative depth.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # beyond float32 is infinite, so no reading either
        depth = (raw.astype(np.float64) * unit).astype(np.float32)
    depth[~np.isfinite(depth) | np.isin(raw, list(invalid))] = 0.0
    depth += 0.0  # turns -0.0 into 0.0
    if (depth < 0).any():
        raise CaptureError(
            f"{where}: {int((depth < 0).sum())} pixels have negative depth, down to {depth.min():g} m; "
            f"{_of_negative(raw)}"
        )
    return depth


def depth_in_metres(
    where: str, stored: NDArray[Any], metres_per_unit: float | None, invalid_values: Collection[int] = ()
) -> NDArray[np.float32]:
    """Return depth images in memory as metres, 0 = no reading: the numbers that reading them from files gives.

    Args:
        where: the door, named in errors.
        stored: (..., H, W), whole numbers of a unit, or floats.
        metres_per_unit: the unit; None = floats are metres.
        invalid_values: stored numbers besides 0 that mean "no reading".

    Raises:
        DTypeError: neither whole numbers nor floats.
        UnitError: whole numbers without a unit, or half of the depth is where no depth camera sees.
        CaptureError: negative depth.
    """
    if stored.dtype.kind not in "iuf" or stored.dtype.itemsize < 2:
        raise DTypeError(
            f"{where}: depth must be whole numbers of 16 bits or more, or floats, got {stored.dtype}; an 8-bit picture "
            "of the depth holds no lengths"
        )
    if metres_per_unit is None and stored.dtype.kind != "f":
        readings = stored[stored > 0]
        length = float(np.median(readings)) if len(readings) else 1000.0
        raise UnitError(f"{where}: depth is {stored.dtype} in a unit that nobody states; {ways(length)}")
    unit = 1.0 if metres_per_unit is None else check_metres_per_unit(where, metres_per_unit)
    if stored.dtype == np.uint16:
        depth = metres_of_numbers(stored, unit, invalid_values)
    else:
        depth = clean_float_depth(where, stored, unit, invalid_values)
    some = slice(None, None, max(1, depth.size // _SAMPLE))
    sample = depth.reshape(-1)[some]
    if len(valid := sample[sample > 0]):
        _warn_of_marks(stored.reshape(-1)[some][sample > 0], DepthUnit(unit))
        if (
            not _NEAREST <= float(np.median(valid[:: max(1, len(valid) >> 12)])) <= _FARTHEST
        ):  # the units that would fit are told from whole images
            check_plausible(
                where, depth.reshape(-1, depth.shape[-1]), DepthUnit(unit), stored.reshape(-1, depth.shape[-1])
            )
    return depth


def _of_negative(raw: NDArray[Any]) -> str:
    marks = np.unique(raw[raw < 0])
    if len(marks) == 1:
        return f"all are {marks[0]:g}: if that marks 'no reading', write 0 or NaN for it when exporting"
    return "is z pointing backwards (OpenGL axes)? Flip the sign when exporting, and write 0 for 'no reading'"


def check_plausible(where: str, depth: NDArray[np.float32], unit: DepthUnit, stored: NDArray[Any]) -> None:
    """Require readings, and half of them at distances that depth cameras see; else name the units that would fit."""
    if _is_plainly_plausible(depth, stored):
        return
    valid = depth[depth > 0]
    if not len(valid):
        raise NoReadingError(f"{where}: no pixel of {depth.size} has a reading; drop this frame")
    _warn_of_marks(stored[depth > 0], unit)
    median = float(np.median(valid[:: max(1, len(valid) >> 16)]))  # 65,536 pixels tell as much as all
    if not _NEAREST <= median <= _FARTHEST:
        fits = unit_fits(np.where(depth > 0, stored, 0), declared=unit)
        likely = [fit for fit in fits if fit.probability >= WORTH_NAMING and _NEAREST <= fit.median <= _FARTHEST]
        named = f"the numbers fit {units_in_words(likely)}" if likely else "give the length of one unit in metres"
        raise UnitError(
            f"{where}: half of the valid depth is {'beyond' if median > 1 else 'within'} {median:g} m with {unit}; is "
            f"metres_per_unit right? {named}"
        )


def _is_plainly_plausible(depth: NDArray[np.float32], stored: NDArray[Any]) -> bool:
    """Say whether counts alone show it, without gathering the readings: a fifth of the time for most images."""
    readings = np.count_nonzero(depth > 0)
    near = np.count_nonzero(depth < _NEAREST) - (depth.size - readings)
    if not (2 * near < readings and 2 * np.count_nonzero(depth > _FARTHEST) < readings):
        return False
    # The highest number of all is that of the readings, unless it is one of those that mean "no reading".
    highest = stored.argmax()
    return bool(stored.dtype != np.uint16 or (stored.flat[highest] not in MARKS and depth.flat[highest] > 0))


def _warn_of_marks(stored: NDArray[Any], unit: DepthUnit) -> None:
    """Say once that a number which usually marks "no reading" becomes points; the text is the same for every file."""
    if stored.dtype != np.uint16 or len(stored) < _FEW or (mark := int(stored.max())) not in MARKS:
        return
    # At the end of the range and more than just below it: a wall that happens to be there has noise.
    share, beside = (stored == mark).mean(), ((stored >= 0.98 * mark) & (stored < mark)).mean()
    if share > max(_MARKED, beside):
        metres = float(metres_of_value(unit.metres, unit.encoding)[mark])
        warnings.warn(
            f"depth images hold {mark}, {MARKS[mark]}, at more than {_MARKED:.1%} of their readings: it becomes "
            f"points at {metres:.5g} m. If it marks 'no reading', say invalid_values=[{mark}]",
            PcdataWarning,
            stacklevel=2,
        )
