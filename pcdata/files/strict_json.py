"""JSON from files: nothing in it is passed over, and nothing in it ends in a traceback.

Python's parser takes the last of two entries with one name, NaN and 1e999 as numbers, and lists within lists until the
stack ends, which then ends whatever walks over them.
"""

from __future__ import annotations

import json
import math
import re
from typing import Any

from pcdata.errors import CacheError, PcdataError

_MAX_DIGITS = 1000  # no float has more than 309 before its point; Python refuses to convert 4,300
_CONTAINERS = (dict, list)
# What could be more than a float or an int can hold: only then is every number looked at.
_LARGE_NUMBER = re.compile(r"(?<![\w\"])\d[\d.]*[eE]\+?\d{3}|(?<!\d)\d{200}")
_MAYBE_LARGE = re.compile(r"[eE]\+?\d{3}|(?<!\d)\d{200}")  # found wherever the other is, and five times as fast
# A backslash as it is written, two surrogates that are one character, and one that is alone.
_ESCAPE = re.compile(r"\\\\|\\ud[89ab]..\\ud[c-f]..|(\\u(d[89a-f]..))", re.IGNORECASE)
_MAX_DEPTH = 100  # a pipeline may have 50 levels as YAML, and each is two here


def parse_json(text: str | bytes) -> Any:
    """Parse JSON; it takes at most about 30 times the memory of the text.

    Raises:
        ValueError: no JSON, a name given twice, a number that is not finite, nested too deeply, or more lists and
            objects than numbers and names in them could fill.
    """
    if not isinstance(text, str):
        text = text.decode(json.detect_encoding(text), "surrogatepass")
    brackets = text.count("[") + text.count("{")
    # An empty one takes 60 bytes of memory for 3 of text; facts have a name or several numbers in each.
    if brackets > 10_000 + len(text) // 6:
        raise ValueError(f"it has {brackets} lists and objects in {len(text)} bytes: damaged or hostile")
    try:
        is_large = _MAYBE_LARGE.search(text) is not None and _LARGE_NUMBER.search(text) is not None
        data = (_EACH_NUMBER if is_large else _PLAIN).decode(text)
    except RecursionError as cause:
        raise ValueError("nested too deeply") from cause
    except MemoryError as cause:
        raise ValueError("it does not fit into the memory") from cause
    level = [data] if type(data) in _CONTAINERS else []
    for _ in range(_MAX_DEPTH + 1):
        if not level:
            return data
        parents, level = level, []
        for parent in parents:
            for part in parent.values() if type(parent) is dict else parent:
                if type(part) in _CONTAINERS:
                    level.append(part)
    raise ValueError(f"nested too deeply, more than {_MAX_DEPTH} levels")


def json_text(data: Any, *, indent: int | None = None) -> str:
    r"""Return JSON that every parser takes: ASCII, numbers alone that are finite, no lone surrogates.

    Those are what Python makes of the bytes of a file name that is no UTF-8: such a byte stands as the text ``\xff``.

    Raises:
        ValueError: a number that is not finite.
    """
    return _ESCAPE.sub(_without_surrogate, json.dumps(data, indent=indent, allow_nan=False))


def json_object(where: str, text: str | bytes, *, error: type[PcdataError]) -> dict[str, Any]:
    """Parse a JSON object.

    Raises:
        PcdataError: of the type ``error``: not what :func:`parse_json` takes, no object, or, of a file that pcdata did
            not write, a text with half a character, which no other file could hold.
    """
    try:
        if not issubclass(error, CacheError):  # a dataset keeps folders whose names are no UTF-8
            _check_whole_characters(text)
        data = parse_json(text)
    except ValueError as cause:
        ours = issubclass(error, CacheError)
        way = "it is damaged: copy it again, or make it anew" if ours else "mend it there, or write it again"
        fault = "it is no UTF-8 text" if isinstance(cause, UnicodeDecodeError) else str(cause)[:300]
        raise error(f"{where}: not valid JSON: {fault}; {way}") from cause
    if not isinstance(data, dict):
        raise error(f"{where}: must be a JSON object, got a {type(data).__name__}")
    return data


def _check_whole_characters(text: str | bytes) -> None:
    plain = text.decode("utf-8", "replace") if isinstance(text, bytes) else text
    if half := next((found[1] for found in _ESCAPE.finditer(plain) if found[1]), None):
        raise ValueError(f"half a character, {half}, is no text")


def _without_surrogate(match: re.Match[str]) -> str:
    if match[1] is None:
        return match[0]
    code = int(match[2], 16)
    return f"\\\\x{code - 0xDC00:02x}" if 0xDC80 <= code <= 0xDCFF else f"\\\\u{code:04x}"


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = dict(pairs)
    if len(found) != len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise ValueError(f"{twice!r:.200} is given twice in one object")
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


# Made once: json.loads makes a decoder for every text.
_PLAIN = json.JSONDecoder(object_pairs_hook=_unique, parse_constant=_refused)
_EACH_NUMBER = json.JSONDecoder(
    object_pairs_hook=_unique, parse_constant=_refused, parse_float=_finite, parse_int=_whole
)
