"""PLY files (Stanford polygon format, version 1.0) <-> clouds. Only vertices are read; faces are skipped.

Format: G. Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError, near_matches
from pcdata.files import read_bytes, replacing
from pcdata.io.cloud_arrays import CloudArrays, from_cloud, narrowest_int, to_cloud
from pcdata.io.numbers_as_text import format_rows, parse_words
from pcdata.io.ply_header import TYPE_NAMES, Element, parse_header
from pcdata.structures import PointCloud, SurfaceMesh

_MAX_BYTES = 1 << 32
_NORMALS, _COLORS = ("nx", "ny", "nz"), ("red", "green", "blue")
_ENCODINGS = {"binary": "binary_little_endian", "binary_big_endian": "binary_big_endian", "ascii": "ascii"}


def read_ply(
    path: str | os.PathLike[str],
    *,
    frame_id: str = "camera",
    metres_per_unit: float | None = None,
) -> PointCloud:
    """Read the vertices of a PLY file as one cloud in metres.

    ``nx ny nz`` become ``normals``; ``red green blue`` (unsigned integers, or floats in 0..1) ``colors``; ``label``
    ``labels``; other single values invariant ``extra``; lists are skipped. Points whose x, y or z is NaN or infinite
    are dropped; ``source_index`` keeps the row in the file.

    Args:
        path: the file, in any of the three encodings.
        frame_id: the frame its coordinates are in; the format does not say.
        metres_per_unit: None = metres, refused when the numbers look like millimetres; the format does not say.

    Raises:
        CaptureError: the file is missing, damaged, or has vertices but none that is finite.
        UnitError: the coordinates cannot be metres.
    """
    where = f"read_ply: {path}"
    data = read_bytes(where, path, max_bytes=_MAX_BYTES)
    encoding, elements, start = parse_header(where, data)
    body = memoryview(data)[start:]
    read = _vertices_of_text if encoding == "ascii" else _vertices_of_bytes
    return to_cloud(
        where, _arrays(where, read(where, elements, body)), frame_id=frame_id, metres_per_unit=metres_per_unit
    )


def write_ply(path: str | os.PathLike[str], cloud: PointCloud | SurfaceMesh, *, encoding: str = "binary") -> None:
    """Write one cloud, or a mesh, in metres as PLY; colours are rounded to 8 bits.

    Written: points, normals, colours, labels, invariant extra fields (many columns become ``name_0``, ``name_1``, ...).
    Not written, because the format has no place: frame, viewpoint, history, ``source_index``.

    Args:
        cloud: a single cloud, or a mesh: its triangles become the list ``vertex_indices`` of the element ``face``.
        path: the file; it appears complete or not at all.
        encoding: ``binary`` (little endian), ``binary_big_endian`` or ``ascii``.

    Raises:
        ShapeError, UnitError, DTypeError, NonFiniteError, CaptureError: the cloud cannot be stored, and why.
    """
    where = f"write_ply: {path}"
    if encoding not in _ENCODINGS:
        raise CaptureError(f"{where}: encoding must be in {tuple(_ENCODINGS)}{near_matches(encoding, _ENCODINGS)}")
    faces = cloud.triangles.cpu().numpy() if isinstance(cloud, SurfaceMesh) else None
    cloud = cloud.vertices if isinstance(cloud, SurfaceMesh) else cloud
    columns = _columns(where, from_cloud(where, cloud))
    lines = ["ply", f"format {_ENCODINGS[encoding]} 1.0", "comment metres; written by pcdata"]
    lines += [f"element vertex {cloud.num_points}"]
    lines += [f"property {TYPE_NAMES[values.dtype.str[1:]]} {name}" for name, values in columns.items()]
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    header = "\n".join([*lines, "end_header", ""]).encode("ascii")
    order = ">" if encoding == "binary_big_endian" else "<"
    if encoding == "ascii":
        body = format_rows(list(columns.values()))
    else:
        rows = np.empty(cloud.num_points, [(name, f"{order}{v.dtype.str[1:]}") for name, v in columns.items()])
        for name, values in columns.items():
            rows[name] = values
        body = rows.tobytes()
    if faces is not None:
        body += _face_bytes(where, faces, encoding == "ascii", order)
    with replacing(where, path) as temporary:
        temporary.write_bytes(header + body)


def _face_bytes(where: str, faces: NDArray[np.int64], is_text: bool, order: str) -> bytes:
    """Return the rows of the element ``face``: 3 and three vertices."""
    if len(faces) and int(faces.max()) >= 1 << 31:
        raise CaptureError(f"{where}: PLY numbers vertices with 32 bits; write fewer, with larger voxels")
    if is_text:
        return format_rows([np.full(len(faces), 3), *faces.T]) if len(faces) else b""
    rows = np.empty(len(faces), [("count", "u1"), ("vertices", f"{order}i4", 3)])
    rows["count"], rows["vertices"] = 3, faces
    return rows.tobytes()


def _vertices_of_bytes(where: str, elements: list[Element], body: memoryview) -> dict[str, NDArray[Any]]:
    offset = 0
    for element in elements:
        dtype = element.row_dtype
        if dtype is None:
            columns, offset = _walk_rows(where, element, body, offset)
        else:
            end = offset + element.count * dtype.itemsize
            if end > len(body):
                raise _truncated(where, element, f"needs {end - offset} bytes but only {len(body) - offset} are left")
            columns = {}
            if element.name == "vertex" and dtype.names:
                rows = np.frombuffer(body[offset:end], dtype)
                columns = {name: rows[name] for name in dtype.names}
            offset = end
        if element.name == "vertex":
            return columns
    raise AssertionError("parse_header saw a vertex element")


def _walk_rows(where: str, element: Element, body: memoryview, offset: int) -> tuple[dict[str, NDArray[Any]], int]:
    """Step over rows that hold lists one by one; each takes at least a byte, so the file's size bounds the work."""
    single: dict[str, list[Any]] = {entry.name: [] for entry in element.properties if entry.length_dtype is None}
    for _ in range(element.count):
        for entry in element.properties:
            if entry.length_dtype is None:
                offset, start = offset + entry.dtype.itemsize, offset
                if offset <= len(body):
                    single[entry.name].append(body[start:offset])
            else:
                start = offset + entry.length_dtype.itemsize
                if start > len(body):
                    raise _truncated(where, element, "ends within a list")
                length = int(np.frombuffer(body[offset:start], entry.length_dtype)[0])
                if length < 0:
                    raise CaptureError(f"{where}: a list of element {element.name!r} has length {length}")
                offset = start + length * entry.dtype.itemsize
            if offset > len(body):
                raise _truncated(where, element, f"ends {offset - len(body)} bytes early")
    dtypes = {entry.name: entry.dtype for entry in element.properties}
    return {name: np.frombuffer(b"".join(cells), dtypes[name]) for name, cells in single.items()}, offset


def _vertices_of_text(where: str, elements: list[Element], body: memoryview) -> dict[str, NDArray[Any]]:
    lines = (words for line in bytes(body).splitlines() if (words := line.split()))
    for element in elements:
        if element.name != "vertex":
            _skip(where, element, lines)
            continue
        rows: list[list[bytes]] = []
        for words in lines:
            if len(rows) == element.count:
                break
            rows.append(_single_words(where, element, words))
        if len(rows) != element.count:
            raise _truncated(where, element, f"has {len(rows)} lines")
        single = [entry for entry in element.properties if entry.length_dtype is None]
        table = np.array(rows, dtype=object).reshape(element.count, len(single))
        return {e.name: parse_words(f"{where}: {e.name}", table[:, i], e.dtype) for i, e in enumerate(single)}
    raise AssertionError("parse_header saw a vertex element")


def _skip(where: str, element: Element, lines: Iterator[list[bytes]]) -> None:
    for row in range(element.count):
        if next(lines, None) is None:
            raise _truncated(where, element, f"has {row} lines")


def _single_words(where: str, element: Element, words: list[bytes]) -> list[bytes]:
    """Return the words of one line that are single values, in order."""
    kept, place = [], 0
    for entry in element.properties:
        if entry.length_dtype is None:
            kept += words[place : place + 1]
            place += 1
        else:
            length = words[place] if place < len(words) else b""
            place += 1 + (int(length) if length.isdigit() and len(length) < 10 else len(words))
    if place != len(words):
        raise CaptureError(f"{where}: a line of element {element.name!r} does not fit its properties: {words!r:.200}")
    return kept


def _truncated(where: str, element: Element, found: str) -> CaptureError:
    return CaptureError(f"{where}: element {element.name!r} of {element.count} rows {found}; is the file truncated?")


def _arrays(where: str, columns: dict[str, NDArray[Any]]) -> CloudArrays:
    """Give the columns their meaning by name."""

    def take(*names: str) -> NDArray[Any] | None:
        if not all(name in columns for name in names):
            return None
        return np.stack([columns.pop(name) for name in names], axis=1)

    found = " ".join(columns)
    xyz = take("x", "y", "z")
    if xyz is None:
        raise CaptureError(f"{where}: vertex properties x, y and z are needed, but the file has {found or 'none'}")
    normals = take(*_NORMALS)
    return CloudArrays(
        xyz=xyz.astype(xyz.dtype.newbyteorder("=")) if xyz.dtype.kind == "f" else xyz.astype(np.float64),
        normals=None if normals is None else normals.astype(np.float64),
        rgb=take(*_COLORS),
        labels=columns.pop("label", None),
        extra=columns,
    )


def _columns(where: str, arrays: CloudArrays) -> dict[str, NDArray[Any]]:
    """Name the (N,) columns."""
    columns: dict[str, NDArray[Any]] = {name: arrays.xyz[:, i] for i, name in enumerate("xyz")}
    if arrays.normals is not None:
        columns |= {name: arrays.normals[:, i] for i, name in enumerate(_NORMALS)}
    if arrays.rgb is not None:
        columns |= {name: arrays.rgb[:, i] for i, name in enumerate(_COLORS)}
    if arrays.labels is not None:
        columns["label"] = narrowest_int(f"{where}: labels", arrays.labels, ("i4", "u4"))
    for name, values in arrays.extra.items():
        parts = {name: values} if values.ndim == 1 else {f"{name}_{i}": values[:, i] for i in range(values.shape[1])}
        for part, column in parts.items():
            if part in columns or part in (*_NORMALS, *_COLORS, "label"):
                raise CaptureError(f"{where}: an extra field cannot be called {part!r}, which PLY uses already")
            is_long = column.dtype == np.int64  # PLY has no such type
            columns[part] = narrowest_int(f"{where}: {part}", column, ("i4", "u4")) if is_long else column
    return columns
