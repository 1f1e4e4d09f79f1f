"""PLY files (Stanford polygon format, version 1.0) <-> clouds. Only vertices are read; faces are skipped.

Format: G. Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError, locates_path, near_matches
from pcdata.files.opening import read_bytes, replacing
from pcdata.io.clouds.arrays import CloudArrays, from_cloud, narrowest_int, to_cloud
from pcdata.io.clouds.header_size import check_header_size
from pcdata.io.clouds.numbers_as_text import format_rows
from pcdata.io.clouds.ply_header import TYPE_NAMES, parse_header
from pcdata.io.clouds.ply_rows import vertices_of_bytes
from pcdata.io.clouds.ply_text import vertices_of_text
from pcdata.io.clouds.properties import arrays_of_columns
from pcdata.io.clouds.statement import SCALAR, read_statement, statement_lines
from pcdata.structures import PointCloud, SurfaceMesh

_MAX_BYTES = 1 << 32
_NORMALS, _COLORS = ("nx", "ny", "nz"), ("red", "green", "blue")
_QUALITY = "quality"
_ENCODINGS = {"binary": "binary_little_endian", "binary_big_endian": "binary_big_endian", "ascii": "ascii"}


@locates_path
def read_ply(
    path: str | os.PathLike[str],
    *,
    frame_id: str | None = None,
    metres_per_unit: float | None = None,
    labels_from: str | None = None,
) -> PointCloud:
    """Read the vertices of a PLY file as one cloud in metres.

    Names count in any case, with or without ``scalar_`` or ``vertex_`` before them. ``nx ny nz`` become ``normals``;
    ``red green blue`` (whole numbers up to 255, 16 bits, or floats in 0..1) ``colors``; ``label``, ``class``,
    ``classification``, ``semantic``, ``segment``, ``instance``, ``object_id`` and their like ``labels``, where all
    values are whole; other single values extra fields, whole numbers among them as integers; lists are skipped. Points
    whose x, y or z is NaN or infinite are dropped; ``source_index`` keeps the row in the file. A file that pcdata wrote
    comes back in its frame and unit, with its viewpoint and the way to its source.

    Args:
        path: the file, in any of the three encodings.
        frame_id: the frame its coordinates are in; None = as the file says, else ``camera``.
        metres_per_unit: None = as the file says, else metres, refused where the numbers do not look like metres.
        labels_from: the property that holds the labels; "" = none of them, None = found by its name.

    Raises:
        CaptureError: the file is missing, damaged, has vertices but none that is finite, or its columns are ambiguous.
        FrameError: the file states another frame.
        UnitError: the coordinates do not look like metres and no unit is stated, or two units are.
    """
    where = f"read_ply: {path}"
    data = read_bytes(where, path, max_bytes=_MAX_BYTES)
    header = parse_header(where, data)
    body = memoryview(data)[header.size :]
    statement = read_statement(where, header.comments)
    read = vertices_of_text if header.encoding == "ascii" else vertices_of_bytes
    columns = read(where, header.elements, body)
    return to_cloud(
        where,
        arrays_of_columns(where, columns, statement, labels_from=labels_from),
        statement=statement,
        frame_id=frame_id,
        metres_per_unit=metres_per_unit,
        viewpoint=statement.viewpoint,
    )


@locates_path
def write_ply(
    path: str | os.PathLike[str],
    cloud: PointCloud | SurfaceMesh,
    *,
    encoding: str = "binary",
    scalar_names: bool = False,
    quality: str | None = None,
) -> None:
    """Write one cloud, or a mesh, as PLY; colors are rounded to 8 bits.

    Written: points, normals, colors, labels, extra fields (many columns become ``name_0``, ``name_1``, ...); as
    comments, which :func:`read_ply` understands and others skip: frame, unit, viewpoint, the way back to the source
    frame, known frames, and what each extra field is. Not written: ``meta``, ``history``, ``layout``, ``source_index``.

    Args:
        cloud: a single cloud, or a mesh: its triangles become the list ``vertex_indices`` of the element ``face``.
        path: the file; it appears complete or not at all.
        encoding: ``binary`` (little endian), ``binary_big_endian`` or ``ascii``.
        scalar_names: call labels and extra fields ``scalar_label``, ``scalar_confidence``, ...: CloudCompare loads what
            is called so as scalar fields, and asks about other names.
        quality: a field of one value a point, such as "labels", that is written once more as the float ``quality``, the
            one scalar that MeshLab reads; :func:`read_ply` skips it.

    Raises:
        ShapeError, UnitError, DTypeError, NonFiniteError, CaptureError: the cloud cannot be stored, and why.

    Source: CloudCompare, ``PlyFilter.cpp`` (names with "SCAL" are scalar fields); vcglib, ``import_ply.h`` (``quality``
        float, ``red green blue`` uchar).
    """
    where = f"write_ply: {path}"
    if encoding not in _ENCODINGS:
        raise CaptureError(f"{where}: encoding must be in {tuple(_ENCODINGS)}{near_matches(encoding, _ENCODINGS)}")
    faces = cloud.triangles.cpu().numpy() if isinstance(cloud, SurfaceMesh) else None
    cloud = cloud.vertices if isinstance(cloud, SurfaceMesh) else cloud
    columns = _columns(where, from_cloud(where, cloud), SCALAR if scalar_names else "")
    if quality is not None:
        columns[_QUALITY] = _quality(where, cloud, quality, columns)
    lines = ["ply", f"format {_ENCODINGS[encoding]} 1.0"]
    labels = f"{SCALAR}label" if scalar_names else "label"
    lines += [f"comment {line}" for line in statement_lines(where, cloud, labels, quality)]
    lines += [f"element vertex {cloud.num_points}"]
    lines += [f"property {TYPE_NAMES[values.dtype.str[1:]]} {name}" for name, values in columns.items()]
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    header = "\n".join([*lines, "end_header", ""]).encode("ascii")
    check_header_size(where, header)
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


def _quality(where: str, cloud: PointCloud, name: str, columns: dict[str, NDArray[Any]]) -> NDArray[np.float32]:
    """Return the values of one field as the float32 that they are drawn by."""
    fields = cloud.fields()
    if name not in fields or fields[name].ndim != 1:
        single = [one for one, values in fields.items() if values.ndim == 1 and one != "source_index"]
        raise CaptureError(
            f"{where}: quality must be a field of one value a point{near_matches(name, single)}, got {name!r}; the "
            f"cloud has {', '.join(single) or 'none'}"
        )
    if _QUALITY in columns:
        raise CaptureError(f"{where}: the cloud has a field 'quality' already; leave quality= out, or rename it")
    values: NDArray[np.float32] = fields[name].detach().cpu().numpy().astype(np.float32)
    return values


def _columns(where: str, arrays: CloudArrays, prefix: str) -> dict[str, NDArray[Any]]:
    """Name the (N,) columns; labels and extra fields begin with the prefix."""
    columns: dict[str, NDArray[Any]] = {name: arrays.xyz[:, i] for i, name in enumerate("xyz")}
    if arrays.normals is not None:
        columns |= {name: arrays.normals[:, i] for i, name in enumerate(_NORMALS)}
    if arrays.rgb is not None:
        columns |= {name: arrays.rgb[:, i] for i, name in enumerate(_COLORS)}
    if arrays.labels is not None:
        columns[f"{prefix}label"] = narrowest_int(f"{where}: labels", arrays.labels, ("i4", "u4"))
    for name, values in arrays.extra.items():
        parts = {name: values} if values.ndim == 1 else {f"{name}_{i}": values[:, i] for i in range(values.shape[1])}
        for plain, column in parts.items():
            part = f"{prefix}{plain}"
            if part in columns or part in (*_NORMALS, *_COLORS, "label", f"{prefix}label"):
                raise CaptureError(f"{where}: an extra field cannot be called {part!r}, which PLY uses already")
            is_long = column.dtype == np.int64  # PLY has no such type
            columns[part] = narrowest_int(f"{where}: {part}", column, ("i4", "u4")) if is_long else column
    return columns
