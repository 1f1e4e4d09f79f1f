"""Columns of Parquet files, some rows at a time, through pyarrow; what a file claims is checked before it is read."""

from __future__ import annotations

import importlib
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError, near_matches
from pcdata.extras import require
from pcdata.files.library_errors import read_by_library
from pcdata.files.opening import MAX_STREAMED_BYTES, open_input

_MAX_ROWS = 1 << 31
_MAX_GROUP_BYTES = 1 << 32  # of one column in one row group, unpacked: an episode of megapixel images
_MAX_GROUP_VALUES = 1 << 30  # of one column in one row group: a run length may claim any number in a few bytes
_BATCH = 1 << 22  # bytes of rows that are decoded at once
_KEPT = 1 << 26  # bytes of rows that stay in memory: those that were asked for last
_BUFFER = 1 << 20  # bytes of a column that are read at once: without it pyarrow reads its whole row group
_NUMBERS = "biuf"


class ParquetColumns:
    """An open file. Rows are counted from 0 through all of its row groups."""

    def __init__(self, where: str, path: Path, inside: Iterable[Path]) -> None:
        """Open a file and look at what it says of itself.

        Raises:
            CaptureError: it is missing, outside, no Parquet file or damaged, or claims what no recording holds.
            MissingExtraError: pyarrow is not installed.
        """
        require("pyarrow")
        self._where, self._path = where, path
        with self._named():
            self._stream = open_input(where, path, max_bytes=MAX_STREAMED_BYTES, inside=inside)
            try:
                parquet = importlib.import_module("pyarrow.parquet")
                self._file = parquet.ParquetFile(self._stream, buffer_size=_BUFFER)
                self._starts = self._checked_groups()
                self.names: list[str] = list(self._file.schema_arrow.names)
            except BaseException:
                self._stream.close()
                raise
        self.num_rows = int(self._starts[-1])
        self._onward: dict[tuple[str, ...], _Onward] = {}
        self._kept: OrderedDict[tuple[tuple[str, ...], int], Any] = OrderedDict()
        self._kept_bytes = 0

    def close(self) -> None:
        """Close the file."""
        self._onward.clear()
        self._kept.clear()
        self._kept_bytes = 0
        self._stream.close()

    def table(self, names: Iterable[str]) -> dict[str, list[Any]]:
        """Return small columns whole, as Python values."""
        names = self._checked_names(names)
        with self._named():
            found = self._file.read(columns=names, use_threads=False)
            return {name: found.column(name).to_pylist() for name in names}

    def numbers(self, name: str) -> NDArray[Any]:  # (rows,)
        """Return a column of one number a row, whole.

        Raises:
            CaptureError: there is none, it is no column of numbers, or a row has none.
        """
        with self._named():
            column = self._file.read(columns=self._checked_names([name]), use_threads=False).column(name)
            found = [_numbers(name, chunk) for chunk in column.chunks]
        values = np.concatenate(found) if found else np.empty(0)
        if len(values) != self.num_rows:
            raise CaptureError(f"{self._where}: {self._path}: column {name!r:.100} must hold one number a row")
        return values

    def row(self, number: int, names: Iterable[str]) -> dict[str, Any]:
        """Return columns of one row: numbers and lists of them as a flat array, all else as Python values.

        Rows near those that were asked for last are in memory; else a row group is read onward from where reading is,
        or from its first row.

        Raises:
            CaptureError: a column is not there, or a value is missing; or there is no such row.
        """
        names = self._checked_names(names)
        if not 0 <= number < self.num_rows:
            raise CaptureError(f"{self._where}: {self._path}: there is no row {number} among {self.num_rows}")
        with self._named():
            start, batch = self._batch(tuple(names), number)
            return {name: _value(name, batch.column(name).slice(number - start, 1)) for name in names}

    def _batch(self, names: tuple[str, ...], number: int) -> tuple[int, Any]:
        """Return the first row of the batch that a row is in, and the batch."""
        for (columns, start), batch in reversed(self._kept.items()):
            if columns == names and start <= number < start + batch.num_rows:
                self._kept.move_to_end((columns, start))
                return start, batch
        group = int(np.searchsorted(self._starts, number, side="right")) - 1
        onward = self._onward.get(names)
        if onward is None or onward.group != group or number < onward.next_row:
            onward = self._onward[names] = _Onward(
                group, int(self._starts[group]), self._batches_of(group, list(names))
            )
        start, batch = onward.to(number)
        self._kept[names, start] = batch
        self._kept_bytes += batch.nbytes
        while self._kept_bytes > _KEPT and len(self._kept) > 1:
            self._kept_bytes -= self._kept.popitem(last=False)[1].nbytes
        return start, batch

    def _batches_of(self, group: int, names: list[str]) -> Iterator[Any]:
        rows = int(self._starts[group + 1] - self._starts[group])
        about = self._file.metadata.row_group(group)
        wanted = set(names)
        size = sum(
            column.total_uncompressed_size
            for column in map(about.column, range(about.num_columns))
            if column.path_in_schema in wanted or any(column.path_in_schema.startswith(f"{name}.") for name in wanted)
        )
        most = max(1, min(rows, _BATCH * rows // max(size, 1)))
        found: Iterator[Any] = self._file.iter_batches(
            batch_size=most, row_groups=[group], columns=names, use_threads=False
        )
        return found

    def _checked_groups(self) -> NDArray[np.int64]:
        """Return the first row of every row group, and the end."""
        about = self._file.metadata
        if not 0 <= about.num_rows <= _MAX_ROWS:
            raise CaptureError(f"claims {about.num_rows} rows")
        starts = [0]
        for number in range(about.num_row_groups):
            group = about.row_group(number)
            for column in map(group.column, range(group.num_columns)):
                if not (
                    0 <= column.total_uncompressed_size <= _MAX_GROUP_BYTES
                    and 0 <= column.num_values <= _MAX_GROUP_VALUES
                ):
                    raise CaptureError(
                        f"claims {column.num_values} values and {column.total_uncompressed_size} bytes of column "
                        f"{column.path_in_schema!r:.100} in one row group; no recording holds so many"
                    )
            starts.append(starts[-1] + group.num_rows)
        if starts[-1] != about.num_rows:
            raise CaptureError(f"claims {about.num_rows} rows but its row groups have {starts[-1]}; it is damaged")
        return np.asarray(starts, dtype=np.int64)

    def _checked_names(self, names: Iterable[str]) -> list[str]:
        names = list(names)
        for name in names:
            if self.names.count(name) != 1:
                hint = near_matches(name, self.names) or f"; it has {', '.join(self.names)[:500]}"
                count = "twice" if name in self.names else "no"
                raise CaptureError(
                    f"{self._where}: {self._path}: has {count} column {name!r:.100}{'' if name in self.names else hint}"
                )
        return names

    def _named(self) -> AbstractContextManager[None]:
        return read_by_library(self._where, self._path, "Parquet file")


class _Onward:
    """Where reading is in a row group."""

    def __init__(self, group: int, start: int, batches: Iterator[Any]) -> None:
        self.group, self.next_row, self._batches = group, start, batches

    def to(self, number: int) -> tuple[int, Any]:
        """Return the first row of the batch that a later row is in, and the batch."""
        while True:
            batch, start = next(self._batches, None), self.next_row
            if batch is None:
                raise CaptureError(f"has no row {number}, which its index says it has; it is damaged")
            self.next_row += batch.num_rows
            if number < self.next_row:
                return start, batch


def _value(name: str, column: Any) -> Any:
    """Return the one value of a column."""
    arrow = importlib.import_module("pyarrow")
    if isinstance(column, arrow.ExtensionArray):
        column = column.storage
    if column.null_count:
        raise CaptureError(f"column {name!r:.100} has no value there")
    inner = column
    while arrow.types.is_list(inner.type) or _is_other_list(arrow, inner.type):
        inner = inner.flatten()
    if arrow.types.is_primitive(inner.type) or arrow.types.is_boolean(inner.type):
        return _numbers(name, inner)
    return column.to_pylist()[0]


def _is_other_list(arrow: Any, kind: Any) -> bool:
    return bool(arrow.types.is_large_list(kind) or arrow.types.is_fixed_size_list(kind))


def _numbers(name: str, values: Any) -> NDArray[Any]:
    if values.null_count:
        raise CaptureError(f"column {name!r:.100} lacks {values.null_count} values")
    found: NDArray[Any] = values.to_numpy(zero_copy_only=False)
    if found.dtype.kind not in _NUMBERS:
        raise CaptureError(f"column {name!r:.100} must hold numbers, but holds {values.type}")
    return found
