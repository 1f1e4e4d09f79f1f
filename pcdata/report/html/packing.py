"""A cloud as a page carries it: few bytes, each number within a bound that is stated.

Columns lie one after another, each as the differences from row to row, and all are deflated: neighbors in an image are
neighbors in space. ``web/src/decode.js`` turns them back.
"""

from __future__ import annotations

import base64
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.structures import PointCloud
from pcdata.structures.kinds import Kind

_LEVELS = 65535  # of a coordinate, and of a number
_MOST_CATEGORIES = 4096  # of a field of whole numbers; one of more is shown as numbers
_MOST_PIXELS = 1 << 32


@dataclass(frozen=True)
class PackedCloud:
    """What the page says of a cloud, and its bytes."""

    said: dict[str, Any]
    content: bytes  # deflated columns

    @property
    def text(self) -> str:
        """The bytes as base64."""
        return base64.b64encode(self.content).decode("ascii")


def pack_cloud(cloud: PointCloud, *, most_points: int) -> PackedCloud:
    """Pack all clouds of a batch as one, with everything that is known of each point.

    Coordinates are rounded to 1/65535 of their extent, colors and normals to 8 bits, other numbers to 1/65535 of their
    range. Of more than ``most_points`` points every k-th is kept.
    """
    stride = max(1, -(-cloud.num_points // most_points))
    arrays = {name: value[::stride] for name, value in cloud.numpy().items() if len(value) == cloud.num_points}
    points = arrays.pop("points").astype(np.float64)
    columns = _Columns()
    lower, step = _range_of(points)
    said: dict[str, Any] = {
        "count": len(points),
        "total": cloud.num_points,
        "frame": cloud.frame_id,
        "unit": cloud.unit,
        "lower": lower.tolist(),
        "step": step.tolist(),
        "bound": float(step.max(initial=0)) / 2,
        "offset": columns.add(np.rint((points - lower) / np.where(step > 0, step, 1)), "uint16"),
    }
    fields = [_pixels(columns, cloud, arrays.pop("source_index", None)), *_views(columns, cloud, stride)]
    for name, value in arrays.items():
        if name not in ("ptr", "viewpoint"):
            fields.append(_field(columns, name, value, cloud.kinds.get(name)))
    order = {"color": 0, "category": 1, "normal": 2, "scalar": 3, "pixel": 4}
    said["fields"] = sorted(filter(None, fields), key=lambda field: order[field["kind"]])
    return PackedCloud(said, zlib.compress(columns.bytes(), 6))


class _Columns:
    """Bytes of columns, one after another."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._length = 0

    def add(self, values: NDArray[Any], dtype: str) -> int:
        """Add one column, or those of a matrix; return where they begin."""
        start = self._length
        for column in values[:, None].T if values.ndim == 1 else values.T:
            column = np.ascontiguousarray(column).astype(np.int64)
            part = np.diff(column, prepend=0).astype(np.dtype(dtype).newbyteorder("<"))  # wraps, and so does decoding
            self._parts.append(part.tobytes())
            self._length += len(self._parts[-1])
        return start

    def bytes(self) -> bytes:
        """All columns."""
        return b"".join(self._parts)


def _range_of(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the smallest value of each column, and the step that divides its extent."""
    if not len(values):
        return np.zeros(values.shape[1:]), np.zeros(values.shape[1:])
    lower = values.min(0)
    return lower, (values.max(0) - lower) / _LEVELS


def _pixels(columns: _Columns, cloud: PointCloud, index: NDArray[np.int64] | None) -> dict[str, Any] | None:
    """Which pixel a point came from, where it came from images."""
    cameras = cloud.meta[0].get("cameras") if cloud.meta else None
    if index is None or not cameras or (len(index) and not 0 <= index.min() <= index.max() < _MOST_PIXELS):
        return None
    size = cameras[0].get("size")
    if not size:
        return None
    views = len(cameras) if len(cloud.meta) == 1 else len(cloud.meta)
    return {
        "name": "pixel",
        "kind": "pixel",
        "type": "uint32",
        "num": 1,
        "size": [int(size[0]), int(size[1])],
        "views": views,
        "offset": columns.add(index, "uint32"),
    }


def _views(columns: _Columns, cloud: PointCloud, stride: int) -> list[dict[str, Any] | None]:
    """Which cloud of a batch a point is of; of captures each is the view of a camera."""
    if len(cloud.meta) < 2:
        return []
    counts = cloud.counts.cpu().numpy()
    return [_category(columns, "camera", np.repeat(np.arange(len(counts)), counts)[::stride])]


def _field(columns: _Columns, name: str, value: NDArray[Any], kind: Kind | None) -> dict[str, Any] | None:
    if name == "colors":
        return _bytes_field(columns, "colors", "color", np.clip(value, 0, 1) * 255)
    if name == "normals" or (kind is Kind.DIRECTION and value.shape[1:] == (3,)):
        return _bytes_field(columns, name, "normal", np.clip(value, -1, 1) * 127.5 + 127.5)
    if value.ndim > 1 and value.shape[1:] != (1,):
        return None  # more than one number: not a color, not a scale
    value = value.reshape(len(value))
    if value.dtype == bool or np.issubdtype(value.dtype, np.integer):
        return _category(columns, name, value.astype(np.int64)) or _scalar(columns, name, value)
    return _scalar(columns, name, value)


def _bytes_field(columns: _Columns, name: str, kind: str, value: NDArray[Any]) -> dict[str, Any]:
    offset = columns.add(np.rint(value), "uint8")
    return {"name": name, "kind": kind, "type": "uint8", "num": 3, "offset": offset}


def _category(columns: _Columns, name: str, value: NDArray[np.int64]) -> dict[str, Any] | None:
    values, places = np.unique(value, return_inverse=True)
    if len(values) > _MOST_CATEGORIES:
        return None
    offset = columns.add(places.reshape(-1), "uint16")
    return {
        "name": name,
        "kind": "category",
        "type": "uint16",
        "num": 1,
        "values": values.tolist(),
        "offset": offset,
    }


def _scalar(columns: _Columns, name: str, value: NDArray[Any]) -> dict[str, Any] | None:
    numbers = value.astype(np.float64)
    finite = np.isfinite(numbers)
    low, step = _range_of(numbers[finite][:, None]) if finite.any() else (np.zeros(1), np.zeros(1))
    said = {"name": name, "kind": "scalar", "type": "uint16", "num": 1, "low": float(low[0])}
    if not finite.all():  # a page has no NaN: its highest level is none
        step = step * (_LEVELS / (_LEVELS - 1))
        said["none"] = _LEVELS
    levels = np.rint((np.where(finite, numbers, low[0]) - low[0]) / (step[0] or 1.0))
    levels = np.where(finite, levels, _LEVELS)
    said["step"] = float(step[0])
    return {**said, "offset": columns.add(levels, "uint16")}
