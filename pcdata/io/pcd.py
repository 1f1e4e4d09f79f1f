"""PCD files (Point Cloud Library, version 0.7) <-> clouds.

Format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html
"""

from __future__ import annotations

import os
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError, add_note, near_matches
from pcdata.files import read_bytes, replacing
from pcdata.io import lzf
from pcdata.io.cloud_arrays import CloudArrays, from_cloud, narrowest_int, to_cloud
from pcdata.io.numbers_as_text import format_rows, parse_words
from pcdata.io.pcd_header import ENCODINGS, PADDING, Field, PcdHeader, parse_header
from pcdata.structures import PointCloud

_MAX_BYTES = 1 << 32
_PAGE = 1 << 16  # PCL rounds compressed files up to a memory page and leaves zeros behind the data
_NORMALS = ("normal_x", "normal_y", "normal_z")


def read_pcd(
    path: str | os.PathLike[str],
    *,
    frame_id: str = "camera",
    metres_per_unit: float | None = None,
) -> PointCloud:
    """Read a PCD file in any of its encodings as one cloud in metres.

    ``rgb`` / ``rgba`` become ``colors`` (alpha is dropped), ``normal_x normal_y normal_z`` ``normals``, ``label``
    ``labels``, every other field an invariant ``extra``. Points whose x, y or z is NaN or infinite carry no reading and
    are dropped; ``source_index`` keeps the row in the file. ``viewpoint`` is the translation of VIEWPOINT;
    ``meta[0]["viewpoint"]`` has all seven numbers (tx ty tz qw qx qy qz), ``meta[0]["organised_size"]`` is [H, W] when
    the rows are the pixels of an image.

    Args:
        path: the file.
        frame_id: the frame its coordinates are in; the format does not say.
        metres_per_unit: None = metres, as PCL has them, refused when the numbers look like millimetres.

    Raises:
        CaptureError: the file is missing, damaged, contradicts itself, or has points but none that is finite.
        UnitError: the coordinates cannot be metres.
    """
    where = f"read_pcd: {path}"
    data = read_bytes(where, path, max_bytes=_MAX_BYTES)
    header, start = parse_header(where, data)
    read = {"ascii": _read_ascii, "binary": _read_binary, "binary_compressed": _read_compressed}[header.encoding]
    columns = read(where, header, memoryview(data)[start:])
    meta: dict[str, Any] = {"viewpoint": list(header.viewpoint)}
    if header.height > 1:
        meta["organised_size"] = [header.height, header.width]
    return to_cloud(
        where,
        _arrays(where, columns),
        frame_id=frame_id,
        metres_per_unit=metres_per_unit,
        viewpoint=header.viewpoint[:3],
        meta=meta,
    )


def write_pcd(path: str | os.PathLike[str], cloud: PointCloud, *, encoding: str = "binary") -> None:
    """Write one cloud in metres as PCD 0.7; colours are rounded to 8 bits, as the format has them.

    Written: points, normals, colours (``rgb``), labels, invariant extra fields, viewpoint. Not written, because the
    format has no place: frame, source frame, history, ``source_index``.

    Args:
        cloud: a single cloud.
        path: the file; it appears complete or not at all.
        encoding: ``ascii``, ``binary`` or ``binary_compressed``.

    Raises:
        ShapeError, UnitError, DTypeError, NonFiniteError, CaptureError: the cloud cannot be stored, and why.
    """
    where = f"write_pcd: {path}"
    if encoding not in ENCODINGS:
        raise CaptureError(f"{where}: encoding must be in {ENCODINGS}{near_matches(encoding, ENCODINGS)}")
    columns = _columns(where, from_cloud(where, cloud), encoding)
    fields = tuple(
        Field(name, {"f": "F", "i": "I", "u": "U"}[values.dtype.kind], values.dtype.itemsize, values.shape[1])
        for name, values in columns.items()
    )
    header = PcdHeader(fields, cloud.num_points, 1, encoding, _seven_numbers(cloud))
    with replacing(where, path) as temporary:
        temporary.write_bytes(header.to_text().encode("ascii") + _body(header, columns))


def _read_binary(where: str, header: PcdHeader, body: memoryview) -> dict[str, NDArray[Any]]:
    _check_length(where, "the points", header.num_points * header.row_bytes, body)
    dtype = np.dtype([(f"f{i}", field.dtype, (field.count,)) for i, field in enumerate(header.fields)])
    rows = np.frombuffer(body, dtype, count=header.num_points)
    return {field.name: rows[f"f{i}"] for i, field in enumerate(header.fields) if field.name != PADDING}


def _read_compressed(where: str, header: PcdHeader, body: memoryview) -> dict[str, NDArray[Any]]:
    """Columns one after another, the whole of it LZF-compressed, behind its two lengths."""
    size = header.num_points * header.row_bytes
    if not size and not len(body):
        body = memoryview(bytes(8))
    if len(body) < 8:
        raise CaptureError(f"{where}: must begin its data with two lengths, 8 bytes, but only {len(body)} are left")
    packed, unpacked = struct.unpack_from("<II", body)
    if unpacked != size:
        raise CaptureError(f"{where}: the header describes {size} bytes of points but the data unpack to {unpacked}")
    _check_length(where, "the compressed data", packed, body[8:])
    try:
        data = lzf.decompress(bytes(body[8 : 8 + packed]), size)
    except CaptureError as error:
        add_note(error, f"in {where}")
        raise
    columns, offset = {}, 0
    for field in header.fields:
        length = header.num_points * field.row_bytes
        if field.name != PADDING:
            column = data[offset : offset + length].view(field.dtype)
            columns[field.name] = column.reshape(header.num_points, field.count)
        offset += length
    return columns


def _check_length(where: str, what: str, expected: int, body: memoryview) -> None:
    spare = len(body) - expected
    if spare < 0:
        raise CaptureError(f"{where}: {what} need {expected} bytes but {len(body)} are left; is the file truncated?")
    if spare > _PAGE or any(body[expected:]):
        raise CaptureError(f"{where}: {what} need {expected} bytes but {len(body)} follow; header or data are wrong")


def _read_ascii(where: str, header: PcdHeader, body: memoryview) -> dict[str, NDArray[Any]]:
    lines = [line for line in bytes(body).splitlines() if line.strip()]
    per_row = sum(field.count for field in header.fields)
    words = b" ".join(lines).split()
    if len(lines) != header.num_points or len(words) != header.num_points * per_row:
        raise CaptureError(
            f"{where}: POINTS {header.num_points} of {per_row} values each must follow, but there are "
            f"{len(lines)} lines with {len(words)} values; is the file truncated?"
        )
    table = np.array(words, dtype=object).reshape(header.num_points, per_row)
    columns, first = {}, 0
    for field in header.fields:
        if field.name != PADDING:
            words_of_field = table[:, first : first + field.count]
            columns[field.name] = parse_words(f"{where}: {field.name}", words_of_field, field.dtype)
        first += field.count
    return columns


def _arrays(where: str, columns: dict[str, NDArray[Any]]) -> CloudArrays:
    """Give the columns their meaning by name."""

    def take(*names: str) -> NDArray[Any] | None:
        if not all(name in columns and columns[name].shape[1] == 1 for name in names):
            return None
        return np.concatenate([columns.pop(name) for name in names], axis=1)

    found = " ".join(columns)
    xyz = take("x", "y", "z")
    if xyz is None:
        raise CaptureError(f"{where}: fields x, y and z are needed, one value each, but the file has {found}")
    rgb = None
    for name in ("rgb", "rgba"):
        if name in columns and rgb is None:
            rgb = _unpack_rgb(where, name, columns.pop(name))
    normals = take(*_NORMALS)
    labels = take("label")
    return CloudArrays(
        xyz=xyz if xyz.dtype.kind == "f" else xyz.astype(np.float64),
        normals=None if normals is None else normals.astype(np.float64),
        rgb=rgb,
        labels=None if labels is None else labels[:, 0],
        extra={name: values[:, 0] if values.shape[1] == 1 else values for name, values in columns.items()},
    )


def _unpack_rgb(where: str, name: str, column: NDArray[Any]) -> NDArray[np.uint8]:
    """Split 0xAARRGGBB, stored as an integer or as the float of the same bits, into (N, 3)."""
    if column.dtype.itemsize != 4 or column.shape[1] != 1:
        found = f"{column.dtype} x {column.shape[1]}"
        raise CaptureError(f"{where}: field {name!r} must be four bytes per point, got {found}")
    channels = np.ascontiguousarray(column).view(np.uint8).reshape(-1, 4)  # little-endian: blue first
    return channels[:, 2::-1]


def _pack_rgb(rgb: NDArray[np.uint8]) -> NDArray[np.uint32]:
    red, green, blue = rgb.astype(np.uint32).T
    return ((red << 16) | (green << 8) | blue).reshape(-1, 1)


def _columns(where: str, arrays: CloudArrays, encoding: str) -> dict[str, NDArray[Any]]:
    """Name the columns, (N, count) each, in the order PCL writes them."""
    columns: dict[str, NDArray[Any]] = {name: arrays.xyz[:, i : i + 1] for i, name in enumerate("xyz")}
    if arrays.normals is not None:
        columns |= {name: arrays.normals[:, i : i + 1] for i, name in enumerate(_NORMALS)}
    if arrays.rgb is not None:
        packed = _pack_rgb(arrays.rgb)
        columns["rgb"] = packed if encoding == "ascii" else packed.view(np.float32)  # both as PCL has it
    if arrays.labels is not None:
        columns["label"] = narrowest_int(f"{where}: labels", arrays.labels, ("u4", "i4", "i8"))[:, None]
    for name, values in arrays.extra.items():
        if name in columns or name in ("rgb", "rgba", "label", PADDING, *_NORMALS):
            raise CaptureError(f"{where}: an extra field cannot be called {name!r}, which means something else in PCD")
        columns[name] = values[:, None] if values.ndim == 1 else values
    return columns


def _body(header: PcdHeader, columns: dict[str, NDArray[Any]]) -> bytes:
    if header.encoding == "ascii":
        return format_rows([column[:, i] for column in columns.values() for i in range(column.shape[1])])
    if header.encoding == "binary":
        rows = np.empty(header.num_points, [(f"f{i}", f.dtype, (f.count,)) for i, f in enumerate(header.fields)])
        for i, column in enumerate(columns.values()):
            rows[f"f{i}"] = column
        return rows.tobytes()
    raw = b"".join(
        column.astype(field.dtype, copy=False).tobytes() for field, column in zip(header.fields, columns.values())
    )
    packed = lzf.compress(raw)
    return struct.pack("<II", len(packed), len(raw)) + packed


def _seven_numbers(cloud: PointCloud) -> tuple[float, ...]:
    """Where the sensor stood, and its orientation if the cloud came with one and has not been moved since."""
    orientation: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)
    known = cloud.meta[0].get("viewpoint")
    if isinstance(known, (list, tuple)) and len(known) == 7 and not cloud.history[0]:
        orientation = tuple(map(float, known[3:]))
    position = [0.0, 0.0, 0.0] if cloud.viewpoint is None else cloud.viewpoint[0].tolist()
    return (*position, *orientation)
