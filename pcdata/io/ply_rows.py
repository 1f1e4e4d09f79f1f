"""The rows behind a PLY header: the columns of the vertices, with everything else in the file accounted for.

Rows without lists are one block of memory. Where rows hold lists, each begins where the one before ends: runs of rows
with lists of equal lengths (triangles) are found by comparing whole blocks, the others are stepped over one by one.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError
from pcdata.io.numbers_as_text import TextLines, line_of, table_columns, text_blocks, typed
from pcdata.io.ply_header import Element

Columns = dict[str, NDArray[Any]]

_RUN = 1 << 12  # rows compared at once
_ALONE = 64  # rows stepped over before another run is tried
_GATHER = 1 << 20  # bytes picked at once
_FACES = 1 << 16  # checked at once
_CORNERS = ("vertex_indices", "vertex_index")


def vertices_of_bytes(where: str, elements: list[Element], body: memoryview) -> Columns:
    """Return the single values of the vertices, and check that the rows of all elements fill the file.

    Raises:
        CaptureError: the rows do not fit the file, or a list has a negative length.
    """
    offset, found = 0, {}
    for element in elements:
        dtype = element.row_dtype
        if dtype is None:
            columns, offset = _rows_with_lists(where, element, body, offset, _vertex(elements).count)
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
            found = columns
    _check_end(where, elements, body[offset:])
    return found


def vertices_of_text(where: str, elements: list[Element], body: memoryview) -> Columns:
    """Return the single values of the vertices, one line each, and check that no other line is left."""
    single = [entry for entry in _vertex(elements).properties if entry.length_dtype is None]
    parts: list[list[NDArray[Any]]] = []
    waiting = [(element, element.count if element.properties else 0) for element in elements]
    for block in text_blocks(where, body):
        lines = block
        while len(lines.bounds) > 1:
            while waiting and not waiting[0][1]:
                waiting.pop(0)
            if not waiting:
                raise CaptureError(
                    f"{where}: a line is left that no element of the header explains: {line_of(lines, 0)!r:.100}; is a "
                    f"count too small? It has {_counts(elements)}"
                )
            element, missing = waiting[0]
            taken = min(missing, len(lines.bounds) - 1)
            mine, lines = _split(lines, taken)
            columns = _columns_of_text(where, element, mine, _vertex(elements).count)
            if element.name == "vertex":
                parts.append(columns)
            waiting[0] = element, missing - taken
    for element, missing in waiting:
        if missing:
            raise _truncated(where, element, f"has {element.count - missing} lines")
    if not parts:
        return {entry.name: np.zeros(0, entry.dtype) for entry in single}
    return {entry.name: np.concatenate([part[i] for part in parts]) for i, entry in enumerate(single)}


# -- binary rows with lists --------------------------------------------------------------------------------------------


@dataclass
class _Segment:
    """Bytes of a row that have a fixed length, and the list behind them; the last one of a row has none."""

    names: list[str]
    dtype: np.dtype
    length_of: Callable[[memoryview, int], tuple[Any, ...]] | None = None
    length_dtype: np.dtype | None = None
    item: np.dtype | None = None
    item_bytes: int = 0
    is_corners: bool = False  # the list names vertices


def _segments(element: Element) -> list[_Segment]:
    segments, fixed = [], []
    for entry in element.properties:
        if entry.length_dtype is None:
            fixed.append((entry.name, entry.dtype))
            continue
        code = entry.length_dtype.str.replace("i1", "b").replace("u1", "B").replace("i2", "h").replace("u2", "H")
        code = code.replace("i4", "i").replace("u4", "I").replace("|", "")
        length_of = struct.Struct(code).unpack_from
        names = [name for name, _ in fixed]
        segments.append(
            _Segment(
                names, np.dtype(fixed), length_of, entry.length_dtype, entry.dtype, entry.dtype.itemsize,
                entry.name in _CORNERS and entry.dtype.kind in "iu",
            )
        )  # fmt: skip
        fixed = []
    return [*segments, _Segment([name for name, _ in fixed], np.dtype(fixed))] if fixed else segments


def _rows_with_lists(
    where: str, element: Element, body: memoryview, offset: int, num_vertices: int
) -> tuple[Columns, int]:
    segments = _segments(element)
    least = sum(one.dtype.itemsize + (one.length_dtype.itemsize if one.length_dtype else 0) for one in segments)
    if element.count * least > len(body) - offset:
        needed = element.count * least
        raise _truncated(where, element, f"needs {needed} bytes or more but only {len(body) - offset} are left")
    kept = [array("q") if element.name == "vertex" and one.names else None for one in segments]
    corners = [one for one in segments if element.name == "face" and one.is_corners]
    if corners:
        kept[segments.index(corners[0])] = array("q")  # whose vertices are checked
    row, alone = 0, _ALONE
    while row < element.count:
        rows, offset = _run(element.count - row, segments, body, offset, kept)
        row += rows
        if rows < _RUN:  # the run stopped at a list of another length
            alone = _ALONE if rows >= _ALONE else min(2 * alone, _RUN)
            count = min(alone, element.count - row)
            offset = _one_by_one(where, element, count, segments, body, offset, kept)
            row += count
    columns: Columns = {}
    for one, starts in zip(segments, kept):
        if starts is not None and one in corners:
            _check_corners(where, element, one, np.frombuffer(starts, np.int64), body, num_vertices)
        elif starts is not None:
            rows_of_segment = _gather(body, np.frombuffer(starts, np.int64), one.dtype)
            columns |= {name: rows_of_segment[name] for name in one.names}
    return {entry.name: columns[entry.name] for entry in element.properties if entry.name in columns}, offset


def _one_by_one(
    where: str,
    element: Element,
    count: int,
    segments: list[_Segment],
    body: memoryview,
    offset: int,
    kept: list[array[int] | None],
) -> int:
    plan = [
        (one.dtype.itemsize, one.length_of, one.length_dtype.itemsize if one.length_dtype else 0, one.item_bytes,
         starts.append if starts is not None else None)
        for one, starts in zip(segments, kept)
    ]  # fmt: skip
    is_plain = all(one.length_dtype != np.dtype("i1") for one in segments)  # bytes are read three times as fast
    try:
        for _ in range(count):
            for fixed, length_of, length_bytes, item_bytes, keep in plan:
                if keep is not None:
                    keep(offset)
                offset += fixed
                if length_bytes == 1 and is_plain:
                    offset += 1 + body[offset] * item_bytes
                elif length_of is not None:
                    (length,) = length_of(body, offset)
                    if length < 0:
                        raise CaptureError(f"{where}: a list of element {element.name!r} has length {length}")
                    offset += length_bytes + length * item_bytes
    except (struct.error, IndexError):
        raise _truncated(where, element, "ends within a list") from None
    if offset > len(body):
        raise _truncated(where, element, f"ends {offset - len(body)} bytes early")
    return offset


def _run(
    most: int, segments: list[_Segment], body: memoryview, offset: int, kept: list[array[int] | None]
) -> tuple[int, int]:
    """Take up to ``_RUN`` rows whose lists are as long as those of the first; none where they do not fit the file."""
    places, end = [], offset  # of each segment's list length
    begins = []
    for one in segments:
        begins.append(end - offset)
        end += one.dtype.itemsize
        if one.length_of is None or one.length_dtype is None:
            continue
        if end + one.length_dtype.itemsize > len(body):
            return 0, offset
        (length,) = one.length_of(body, end)
        if length < 0:
            return 0, offset
        places.append((end - offset, one.length_dtype.itemsize))
        end += one.length_dtype.itemsize + length * one.item_bytes
    size = end - offset
    rows = min(most, _RUN, (len(body) - offset) // size)
    if rows < 2:
        return 0, offset
    table = np.frombuffer(body[offset : offset + rows * size], np.uint8).reshape(rows, size)
    same = np.ones(rows, bool)
    for place, width in places:
        same &= (table[:, place : place + width] == table[0, place : place + width]).all(axis=1)
    if not same.all():
        rows = int(np.argmin(same))
    starts = offset + size * np.arange(rows, dtype=np.int64)
    for begin, own in zip(begins, kept):
        if own is not None:
            own.frombytes((starts + begin).tobytes())
    return rows, offset + rows * size


def _check_corners(
    where: str,
    element: Element,
    segment: _Segment,
    starts: NDArray[np.int64],
    body: memoryview,
    num_vertices: int,
) -> None:
    """Require the vertices of faces to be there: where a count is wrong, faces are read from other bytes."""
    if segment.item is None or segment.length_dtype is None:
        return
    raw = np.frombuffer(body, np.uint8)
    for first in range(0, len(starts), _FACES):
        places = starts[first : first + _FACES] + segment.dtype.itemsize
        lengths = _gather(body, places, np.dtype([("n", segment.length_dtype)]))["n"].astype(np.int64)
        places = places + segment.length_dtype.itemsize
        pitch = int(places[1] - places[0]) if len(places) > 1 else 1
        if (lengths == lengths[0]).all() and (np.diff(places) == pitch).all():  # triangles: no need to pick them
            shape, strides = (len(places), int(lengths[0])), (pitch, segment.item_bytes)
            corners = np.ndarray(shape, segment.item, body, int(places[0]) if lengths[0] else 0, strides)
            _check_named(where, element, corners, num_vertices)
            continue
        for part in _in_parts(lengths, _GATHER // segment.item_bytes):
            at = _of_lists(places[part], lengths[part], segment.item_bytes)
            corners = raw[at[:, None] + np.arange(segment.item_bytes)].reshape(-1).view(segment.item)
            _check_named(where, element, corners, num_vertices)


def _check_named(where: str, element: Element, corners: NDArray[Any], num_vertices: int) -> None:
    if corners.size and not 0 <= int(corners.min()) <= int(corners.max()) < num_vertices:
        raise CaptureError(
            f"{where}: element {element.name!r} names the vertices {int(corners.min())} to {int(corners.max())}, but "
            f"there are {num_vertices}; is a count wrong, or the file damaged?"
        )


def _in_parts(lengths: NDArray[np.int64], most: int) -> list[slice]:
    """Cut rows into parts of about ``most`` items."""
    part = np.cumsum(lengths) // most
    cuts = [0, *(np.flatnonzero(np.diff(part)) + 1).tolist(), len(lengths)]
    return [slice(a, b) for a, b in pairwise(cuts)]


def _of_lists(starts: NDArray[np.int64], lengths: NDArray[np.int64], step: int) -> NDArray[np.int64]:
    """Return where every item of lists lies, by where the lists start."""
    ends = np.cumsum(lengths)
    within = np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - lengths, lengths)
    return np.repeat(starts, lengths) + step * within


def _gather(body: memoryview, starts: NDArray[np.int64], dtype: np.dtype) -> NDArray[Any]:
    """Return the packed rows that begin at the given bytes."""
    raw = np.frombuffer(body, np.uint8)
    rows = np.empty((len(starts), dtype.itemsize), np.uint8)
    step = max(1, _GATHER // dtype.itemsize)
    within = np.arange(dtype.itemsize)
    for first in range(0, len(starts), step):
        rows[first : first + step] = raw[starts[first : first + step, None] + within]
    return rows.reshape(-1).view(dtype)


def _check_end(where: str, elements: list[Element], rest: memoryview) -> None:
    """Allow the line end or the zeros that some writers put behind the data, if they are less than a row."""
    if not len(rest):
        return
    smallest = min((element.row_dtype.itemsize for element in elements if element.row_dtype), default=0)
    if len(rest) < max(3, smallest) and not bytes(rest).strip(b"\0\r\n\x1a"):
        return
    raise CaptureError(
        f"{where}: {len(rest)} bytes are left that no element of the header explains; is a count too small? It has "
        f"{_counts(elements)}"
    )


# -- text --------------------------------------------------------------------------------------------------------------


def _columns_of_text(where: str, element: Element, lines: TextLines, num_vertices: int) -> list[NDArray[Any]]:
    if element.row_dtype is not None:
        names, dtypes = [e.name for e in element.properties], [e.dtype for e in element.properties]
        return table_columns(where, names, dtypes, lines)
    place, ends = lines.bounds[:-1].copy(), lines.bounds[1:]
    columns = []
    for entry in element.properties:
        _check_lines(where, element, lines, place < ends)
        found = lines.values[place]
        if entry.length_dtype is None:
            columns.append(typed(f"{where}: {entry.name}", found, entry.dtype, list))  # PLY has no 64-bit integers
            place += 1
        else:
            _check_lines(where, element, lines, (found >= 0) & (found == np.rint(found)) & (found <= ends - place))
            lengths = found.astype(np.int64)
            if element.name == "face" and entry.name in _CORNERS:
                _check_named(where, element, lines.values[_of_lists(place + 1, lengths, 1)], num_vertices)
            place += 1 + lengths
    _check_lines(where, element, lines, place == ends)
    return columns


def _check_lines(where: str, element: Element, lines: TextLines, good: NDArray[np.bool_]) -> None:
    if not good.all():
        line = line_of(lines, int(np.argmin(good)))
        raise CaptureError(f"{where}: a line of element {element.name!r} does not fit its properties: {line!r:.200}")


def _split(lines: TextLines, count: int) -> tuple[TextLines, TextLines]:
    """Cut a block behind its first ``count`` lines."""
    if count == len(lines.bounds) - 1:
        return lines, TextLines(b"", lines.values[:0], np.zeros(1, np.int64))
    words = int(lines.bounds[count])
    head = TextLines(lines.text, lines.values[:words], lines.bounds[: count + 1], lines.first)
    tail = TextLines(lines.text, lines.values[words:], lines.bounds[count:] - words, lines.first + count)
    return head, tail


# -- shared ------------------------------------------------------------------------------------------------------------


def _vertex(elements: list[Element]) -> Element:
    return next(element for element in elements if element.name == "vertex")


def _counts(elements: list[Element]) -> str:
    return ", ".join(f"element {element.name[:40]} {element.count}" for element in elements[:8])


def _truncated(where: str, element: Element, found: str) -> CaptureError:
    return CaptureError(f"{where}: element {element.name!r} of {element.count} rows {found}; is the file truncated?")
