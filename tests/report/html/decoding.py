"""What the page's script does with a packed cloud, in NumPy."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np

from pcdata.report.html.packing import PackedCloud


def decoded(packed: PackedCloud) -> dict[str, np.ndarray]:
    """Return positions and every field by name, as numbers that the page shows."""
    content = zlib.decompress(packed.content)
    said = packed.said
    found = {"points": np.array(said["lower"]) + np.array(said["step"]) * _columns(content, said, "uint16", 3)}
    for field in said["fields"]:
        columns = _columns(content, {**field, "count": said["count"]}, field["type"], field["num"])
        if field["kind"] == "category":
            columns = np.array(field["values"])[columns] if len(columns) else columns
        elif field["kind"] == "scalar":
            levels = columns
            columns = field["low"] + field["step"] * levels
            columns = np.where(levels == field.get("none", -1), np.nan, columns)
        found[field["name"]] = columns
    return found


def _columns(content: bytes, said: dict[str, Any], dtype: str, num: int) -> np.ndarray:
    kind = np.dtype(dtype).newbyteorder("<")
    count = said["count"]
    read = np.frombuffer(content, kind, count * num, said["offset"]).reshape(num, count)
    return np.cumsum(read, axis=1, dtype=np.dtype(dtype)).T.astype(np.int64)
