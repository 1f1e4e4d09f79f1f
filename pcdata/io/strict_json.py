"""JSON from files: nothing in it is passed over, and nothing in it ends in a traceback.

Python's parser takes the last of two entries with one name, and NaN and 1e999 as numbers.
"""

from __future__ import annotations

import json
import math
from typing import Any

from pcdata.errors import CaptureError, PcdataError
from pcdata.io.sample_names import name_some

_MAX_DIGITS = 1000  # no float has more than 309 before its point; Python refuses to convert 4,300


def json_object(where: str, text: str | bytes, *, error: type[PcdataError] = CaptureError) -> dict[str, Any]:
    """Parse a JSON object.

    Raises:
        PcdataError: of the type ``error``: no JSON, no object, a name given twice, a number that is not finite, or
            nested too deeply.
    """
    try:
        data = json.loads(
            text, object_pairs_hook=_unique, parse_constant=_refused, parse_float=_finite, parse_int=_whole
        )
    except RecursionError as cause:
        raise error(f"{where}: not valid JSON: nested too deeply") from cause
    except (ValueError, MemoryError) as cause:
        raise error(f"{where}: not valid JSON: {str(cause)[:300] or type(cause).__name__}") from cause
    if not isinstance(data, dict):
        raise error(f"{where}: must be a JSON object, got a {type(data).__name__}")
    return data


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = dict(pairs)
    if len(found) != len(pairs):
        seen: set[str] = set()
        twice = {key for key, _ in pairs if key in seen or seen.add(key)}  # type: ignore[func-returns-value]
        raise ValueError(f"given twice: {name_some(twice)}")
    return found


def _refused(name: str) -> None:
    raise ValueError(f"{name} is not a finite number")


def _finite(digits: str) -> float:
    value = float(digits)
    if not math.isfinite(value):
        raise ValueError(f"{digits[:30]} is not a finite number")
    return value


def _whole(digits: str) -> int:
    if len(digits) > _MAX_DIGITS:
        raise ValueError(f"a number of {len(digits)} digits is none that can be meant")
    return int(digits)
