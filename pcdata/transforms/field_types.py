"""The types that transforms' fields are made of: plain, JSON-able values with their limits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import annotated_types
from annotated_types import Ge, Gt, Interval, MinLen

from pcdata.sensors import SensorProfile
from pcdata.structures import METRE, Confidence

# A length in a unit: its step refuses clouds in another.
Metres = Annotated[float, Gt(0), annotated_types.Unit(METRE)]
SquareMetres = Annotated[float, Gt(0), annotated_types.Unit(METRE)]  # likewise
Unit = Literal["m", "normalized"]
NonNegative = Annotated[float, Ge(0)]
Positive = Annotated[float, Gt(0)]
Fraction = Annotated[float, Interval(ge=0, le=1)]
Count = Annotated[int, Ge(1)]
Name = Annotated[str, MinLen(1)]
Vec3 = tuple[float, float, float]
Row4 = tuple[float, float, float, float]
Matrix4 = tuple[Row4, Row4, Row4, Row4]  # row-major, acts on column vectors

# What the values of several points become, where not as their kind says.
Reduction = Literal["mean", "vote", "first", "nearest", "min", "max"]
# What a sampler does with a cloud that has fewer points than asked.
IfShort = Literal["error", "repeat", "tile", "zeros", "keep"]


# The levels that a minimum can ask for, by the names of Confidence.
ConfidenceName = Literal["hallucinated", "completed", "reliable"]


def confidence_named(name: ConfidenceName) -> Confidence:
    """Return the level of this name."""
    return Confidence[name.upper()]


@dataclass(frozen=True)
class FromSensor:
    """Marks, inside ``Annotated``, a field for which a configuration may say ``sensor`` instead of a value."""

    figure: Callable[[SensorProfile, float], float | str]  # of the sensor's profile and the reference depth in metres
