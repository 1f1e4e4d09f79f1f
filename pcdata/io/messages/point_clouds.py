"""PointCloud2 messages: rows of named fields, which mean what the fields of a PCD file of these names mean.

Source: sensor_msgs/PointCloud2 and PointField.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError
from pcdata.io.clouds.arrays import to_cloud
from pcdata.io.clouds.properties import arrays_of_columns
from pcdata.io.clouds.statement import read_statement
from pcdata.io.images.reading import MAX_PIXELS
from pcdata.structures import PointCloud

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_MOST_FIELDS = 100


def cloud_of(where: str, message: Any, *, frame_id: str, metres_per_unit: float | None = None) -> PointCloud:
    """Return the cloud that a PointCloud2 is, in the frame of its header.

    Rows whose coordinates are NaN or infinite carry no reading and are dropped; ``source_index`` keeps the row, and
    ``meta[0]["organized_size"]`` is [H, W] where the rows are the pixels of an image. ``rgb`` packed into a float
    becomes colors.

    Raises:
        CaptureError: the message contradicts itself, or has no coordinates.
        UnitError: the coordinates do not look like metres.
    """
    columns = _columns(where, message)
    statement = read_statement(where, ())
    meta = {"organized_size": [int(message.height), int(message.width)]} if int(message.height) > 1 else {}
    return to_cloud(
        where,
        arrays_of_columns(where, columns, statement),
        statement=statement,
        frame_id=frame_id,
        metres_per_unit=metres_per_unit,
        viewpoint=None,
        meta=meta,
    )


def _columns(where: str, message: Any) -> dict[str, NDArray[Any]]:
    height, width, step, row = (int(getattr(message, name)) for name in ("height", "width", "point_step", "row_step"))
    data = np.asarray(message.data, np.uint8)
    if not 0 < height * width <= MAX_PIXELS:
        raise CaptureError(f"{where}: a cloud must have 1 .. {MAX_PIXELS} points, this one claims {width}x{height}")
    if step < 1 or row < width * step or data.size < row * (height - 1) + width * step:
        raise CaptureError(
            f"{where}: {width}x{height} points of {step} bytes in rows of {row} do not fit {data.size} bytes; it is "
            "damaged"
        )
    if not 0 < len(message.fields) <= _MOST_FIELDS:
        raise CaptureError(f"{where}: a cloud must have 1 .. {_MOST_FIELDS} fields, this one has {len(message.fields)}")
    rows = np.zeros((height, row), np.uint8)
    rows.reshape(-1)[: data.size] = data[: rows.size]  # the padding of the last row may be missing
    points = np.ascontiguousarray(rows[:, : width * step]).reshape(height * width, step)
    order, columns = ">" if message.is_bigendian else "<", dict[str, NDArray[Any]]()
    for field in message.fields:
        kind, count, offset = _TYPES.get(int(field.datatype)), max(1, int(field.count)), int(field.offset)
        if kind is None or offset + count * np.dtype(kind).itemsize > step or field.name in columns:
            raise CaptureError(f"{where}: field {field.name!r:.60} is given twice or lies outside of its point")
        end = offset + count * np.dtype(kind).itemsize
        values = np.ascontiguousarray(points[:, offset:end]).view(f"{order}{kind}").astype(kind)
        columns[str(field.name)] = values[:, 0] if count == 1 else values
    return columns
