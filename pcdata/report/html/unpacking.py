"""A packed cloud back as arrays: what the page's script does, for what draws without a browser."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.report.html.packing import PackedCloud


@dataclass(frozen=True)
class UnpackedCloud:
    """A cloud as a page shows it.

    Args:
        points: (N, 3) float64.
        fields: name -> (N,) or (N, 3) values: colors and normals 0 to 255, numbers of categories, numbers (NaN = none).
        kinds: name -> color, category, normal, scalar or pixel.
    """

    points: NDArray[np.float64]
    fields: dict[str, NDArray[Any]]
    kinds: dict[str, str]


def unpack_cloud(packed: PackedCloud) -> UnpackedCloud:
    """Return the points and what is known of each, as exact as they were packed."""
    said, content = packed.said, zlib.decompress(packed.content)
    count = said["count"]

    def columns(kind: str, offset: int, num: int) -> NDArray[Any]:
        stored = np.dtype(kind).newbyteorder("<")
        steps = np.frombuffer(content, stored, count * num, offset).reshape(num, count)
        return np.cumsum(steps, axis=1, dtype=kind).T  # wraps, as the differences did

    points = np.array(said["lower"]) + np.array(said["step"]) * columns("uint16", said["offset"], 3)
    fields: dict[str, NDArray[Any]] = {}
    for one in said["fields"]:
        values = columns(one["type"], one["offset"], one["num"])
        if one["kind"] == "category":
            values = np.array(one["values"], dtype=np.int64)[values[:, 0]] if count else values[:, 0]
        elif one["kind"] == "scalar":
            levels = values[:, 0]
            values = one["low"] + one["step"] * levels.astype(np.float64)
            values[levels == one.get("none", -1)] = np.nan
        fields[one["name"]] = values
    return UnpackedCloud(points, fields, {one["name"]: one["kind"] for one in said["fields"]})
