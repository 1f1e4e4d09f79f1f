"""When each capture was taken: ``timestamps.json`` beside the images."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path

from pcdata.errors import CaptureError
from pcdata.files.opening import read_text, replacing
from pcdata.files.strict_json import json_object
from pcdata.io.sources.source import check_partners

TIMESTAMPS = "timestamps.json"
_MAX_BYTES = 1 << 26  # two million names
LONGEST = 1e12  # seconds, 30,000 years: more are microseconds or nanoseconds


def read_timestamps(path: Path, ids: Iterable[str]) -> dict[str, float]:
    """Read ``{"NAME": seconds, ...}``, one number for every sample.

    The seconds may count from any moment, the same for all.

    Raises:
        CaptureError: the file is no such JSON object, or names other samples than there are.
    """
    where = f"read_timestamps: {path}"
    times = json_object(where, read_text(where, path, max_bytes=_MAX_BYTES), error=CaptureError)
    if not all(_is_time(time) for time in times.values()):
        raise CaptureError(f'{where}: must be a JSON object of seconds by name, such as {{"0001": 12.033}}')
    check_partners(where, ids, {"timestamp": times})
    return {name: float(time) for name, time in times.items()}


def write_timestamps(path: Path, times: Mapping[str, float]) -> None:
    """Write the seconds of captures by name for :func:`read_timestamps`."""
    lines = ",\n".join(f" {json.dumps(name)}: {json.dumps(time, allow_nan=False)}" for name, time in times.items())
    with replacing(f"write_timestamps: {path}", path) as temporary:
        temporary.write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")


def _is_time(value: object) -> bool:
    # A bound instead of isfinite, which cannot take the whole numbers of any length that JSON allows.
    return isinstance(value, (int, float)) and not isinstance(value, bool) and -LONGEST < value < LONGEST
