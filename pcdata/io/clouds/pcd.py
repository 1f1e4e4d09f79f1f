"""PCD files (Point Cloud Library, version 0.7) <-> clouds.

Format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html
"""

from __future__ import annotations

import os
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError, add_note, locates_path, near_matches
from pcdata.files.opening import read_bytes, replacing
from pcdata.io.clouds import lzf
from pcdata.io.clouds.arrays import CloudArrays, from_cloud, narrowest_int, to_cloud
from pcdata.io.clouds.header_size import check_header_size
from pcdata.io.clouds.numbers_as_text import format_rows, table_columns, text_blocks
from pcdata.io.clouds.pcd_header import ENCODINGS, PADDING, Field, PcdHeader, parse_header
from pcdata.io.clouds.properties import arrays_of_columns
from pcdata.io.clouds.statement import read_statement, statement_lines
from pcdata.structures import PointCloud

_MAX_BYTES = 1 << 32
_PAGE = 1 << 16  # PCL rounds compressed files up to a memory page and leaves zeros behind the data
_NORMALS = ("normal_x", "normal_y", "normal_z")


@locates_path
def read_pcd(
    path: str | os.PathLike[str],
    *,
    frame_id: str | None = None,
    metres_per_unit: float | None = None,
    labels_from: str | None = None,
) -> PointCloud:
    """Read a PCD file in any of its encodings as one cloud in metres.

    ``rgb`` / ``rgba`` become ``colors`` (alpha is dropped), ``normal_x normal_y normal_z`` ``normals``, ``label`` and
    its like (see :func:`read_ply`) ``labels``, ``vp_x vp_y vp_z`` the viewpoint of each point, every other field an
    extra. Points whose x, y or z is NaN or infinite carry no reading and are dropped; ``source_index`` keeps the row in
    the file. ``viewpoint`` is the translation of VIEWPOINT; ``meta[0]["viewpoint"]`` has all seven numbers
    (tx ty tz qw qx qy qz), ``meta[0]["organized_size"]`` is [H, W] when the rows are the pixels of an image; where the
    points prove a pinhole camera, ``layout`` is that image. A file that pcdata wrote comes back in its frame and unit,
    with the way to its source.

    Args:
        path: the file.
        frame_id: the frame its coordinates are in; None = as the file says, else ``camera``.
        metres_per_unit: None = as the file says, else metres, refused where the numbers do not look like metres.
        labels_from: the field that holds the labels; "" = none of them, None = found by its name.

    Raises:
        CaptureError: the file is missing, damaged, contradicts itself, has points but none that is finite, or its
            fields are ambiguous.
        FrameError: the file states another frame.
        UnitError: the coordinates do not look like metres and no unit is stated, or two units are.
    """
    where = f"read_pcd: {path}"
    data = read_bytes(where, path, max_bytes=_MAX_BYTES)
    header, start = parse_header(where, data)
    statement = read_statement(where, header.comments)
    read = {"ascii": _read_ascii, "binary": _read_binary, "binary_compressed": _read_compressed}[header.encoding]
    columns = {
        name: values[:, 0] if values.shape[1] == 1 else values
        for name, values in read(where, header, memoryview(data)[start:]).items()
    }
    meta: dict[str, Any] = {"viewpoint": list(header.viewpoint)}
    if header.height > 1:
        meta["organized_size"] = [header.height, header.width]
    is_own = statement.frame_id is not None
    return to_cloud(
        where,
        arrays_of_columns(where, columns, statement, labels_from=labels_from),
        statement=statement,
        frame_id=frame_id,
        metres_per_unit=metres_per_unit,
        viewpoint=statement.viewpoint if is_own else header.viewpoint[:3],
        meta=meta,
    )


@locates_path
def write_pcd(path: str | os.PathLike[str], cloud: PointCloud, *, encoding: str = "binary") -> None:
    """Write one cloud as PCD 0.7; colors are rounded to 8 bits, as the format has them.

    Written: points, normals, colors (``rgb``), labels, extra fields, viewpoint; as comments, which :func:`read_pcd`
    understands and others skip: frame, unit, the way back to the source frame, known frames, and what each extra field
    is. Not written: ``meta``, ``history``, ``layout``, ``source_index``.

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
    comments = statement_lines(where, cloud, "label")
    header = PcdHeader(fields, cloud.num_points, 1, encoding, _seven_numbers(cloud), comments=tuple(comments))
    text = header.to_text().encode("ascii")
    check_header_size(where, text)
    with replacing(where, path) as temporary:
        temporary.write_bytes(text + _body(header, columns))


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
    names = [field.name for field in header.fields for _ in range(field.count)]
    dtypes = [field.dtype for field in header.fields for _ in range(field.count)]
    blocks, found = [], 0
    for lines in text_blocks(where, body):
        found += len(lines.bounds) - 1
        if found > header.num_points:
            break
        blocks.append(table_columns(where, names, dtypes, lines))
    if found != header.num_points:
        raise CaptureError(
            f"{where}: POINTS {header.num_points} lines of {len(names)} values each must follow, but there are "
            f"{found}{' or more' if found > header.num_points else ''}; is the file truncated?"
        )
    columns, first = {}, 0
    for field in header.fields:
        if field.name != PADDING:
            parts = [np.stack(block[first : first + field.count], axis=1) for block in blocks]
            columns[field.name] = np.concatenate(parts) if parts else np.zeros((0, field.count), field.dtype)
        first += field.count
    return columns


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
