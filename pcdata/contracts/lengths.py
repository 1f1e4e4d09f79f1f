"""The unit of lengths that arrive as plain numbers: one rule for every door that reads coordinates.

Whoever states a unit is believed. Numbers without one are taken as metres as long as they look like metres: a depth
camera or a robot sees a thing of millimetres or a room, and a cup in millimetres is 80 wide. Between the two lies a
gap, so a length beyond :data:`WIDEST` is asked about, never guessed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import UnitError

NARROWEST = 1e-3  # metres: no cloud is as narrow unless its unit was applied twice, or it is in kilometres
WIDEST = 20.0  # metres: above every room that a depth camera scans, below every object in millimetres but a screw
FARTHEST = 100.0  # metres from the sensor or the origin: above the range of depth cameras; half a metre is 500 mm
_PLAUSIBLE = (0.005, FARTHEST)  # metres that a candidate unit should give: from a screw to a hall
_FEW = 100  # fewer points may lie within a millimetre by chance: two returns from one spot
_SAMPLE = 1 << 14  # points that tell as much as all
_STRAY = 2.0  # per cent of the points at each end of an axis that may be flying pixels

UNITS = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254, "metres": 1.0}


def check_metres_per_unit(where: str, metres_per_unit: float) -> float:
    """Return the factor as a float; it must lie in (0, 1].

    No sensor stores a unit longer than a metre, and the bound catches a divisor (1000, 5000) given in its place.
    """
    ok = isinstance(metres_per_unit, (int, float)) and not isinstance(metres_per_unit, bool)
    if not ok or not 0 < metres_per_unit <= 1:
        raise UnitError(
            f"{where}: metres_per_unit must be a number above 0 and at most 1, got {metres_per_unit!r}; "
            "0.001 for millimetres, 1.0 for metres, 1 / factor where a data set documents a divisor"
        )
    return float(metres_per_unit)


def width_of_points(points: NDArray[Any]) -> float:
    """Return the longest side of the box around (N, 3) finite points, in their own unit; 0.0 where there are none.

    Two per cent at each end of every axis do not count, as a few flying pixels would decide it otherwise.
    """
    if not len(points):
        return 0.0
    low, high = np.percentile(_sample(points), (_STRAY, 100.0 - _STRAY), axis=0)
    return float((high - low).max())


def check_metres(
    where: str,
    points: NDArray[Any],
    metres_per_unit: float | None,
    *,
    viewpoint: Any = (0.0, 0.0, 0.0),
    argument: str = "metres_per_unit",
) -> float:
    """Return how many metres a unit of (N, 3) finite coordinates has; an unstated unit must look like metres.

    Args:
        where: the door, named in the error.
        points: coordinates as they arrived.
        metres_per_unit: as stated by the caller or the file, None = nobody says.
        viewpoint: where the sensor stood, in the same unit and frame.
        argument: how the caller states the unit at this door.

    Raises:
        UnitError: nobody says, and the points are too wide or too far for metres; or the stated unit makes points that
            are fine as they stand smaller than a millimetre.
    """
    width = width_of_points(points)
    if metres_per_unit is not None:
        unit = check_metres_per_unit(where, metres_per_unit)
        if len(points) >= _FEW and 0 < width * unit < NARROWEST <= width <= WIDEST:
            raise UnitError(
                f"{where}: {argument}={unit:g} makes the points {width * unit:.3g} m wide, but as they stand they are "
                f"{width:.3g}, which looks like metres already; pass {argument}=1.0"
            )
        return unit
    if width > WIDEST:
        raise UnitError(
            f"{where}: the points are {width:.4g} wide in a unit that nobody states; {ways(width, argument)}"
        )
    if len(points):
        distance = float(np.median(np.linalg.norm(_sample(points) - np.asarray(viewpoint, np.float64), axis=1)))
        if distance > FARTHEST:
            raise UnitError(
                f"{where}: half of the points are {distance:.4g} or more from the sensor in a unit that nobody states; "
                f"{ways(distance, argument)}"
            )
    return 1.0


def check_depth(where: str, readings: NDArray[Any]) -> None:
    """Require depth in memory, which cannot state a unit, to look like metres.

    Args:
        where: the door, named in the error.
        readings: depths along z, without those that mean "no reading"; a sample will do.

    Raises:
        UnitError: half of the readings are farther than any depth camera sees, and what to multiply them by.
    """
    if not len(readings):
        return
    median = float(np.median(readings))
    if median > FARTHEST:
        named = plausible_units(median)
        ways_out = " or ".join(f"{unit:g} if it is in {name} ({median * unit:.3g} m)" for name, unit in named.items())
        raise UnitError(
            f"{where}: half of the depth is beyond {median:.4g}; depth must be in metres: "
            f"{'multiply it by ' + ways_out if ways_out else 'convert it'}"
        )


def plausible_units(length: float) -> dict[str, float]:
    """Return the units, name -> metres, in which a length is that of an object or a room; several may fit."""
    low, high = _PLAUSIBLE
    return {name: unit for name, unit in UNITS.items() if low <= length * unit <= high}


def ways(length: float, argument: str = "metres_per_unit") -> str:
    """Say how to state each unit that fits, and metres, and what the length would be then."""
    named = plausible_units(length) | {"metres": 1.0}
    choices = [f"{argument}={unit:g} if these are {name} ({length * unit:.3g} m)" for name, unit in named.items()]
    return f"pass {', or '.join(choices)}"


def _sample(points: NDArray[Any]) -> NDArray[np.float64]:
    return np.asarray(points[:: max(1, len(points) // _SAMPLE)], np.float64)
