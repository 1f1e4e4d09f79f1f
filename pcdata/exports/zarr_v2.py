"""Zarr version 2 directories, written without the zarr package: groups, and arrays that grow row by row.

Source: Zarr storage specification version 2 (zarr-specs.readthedocs.io, v2/v2.0).
"""

from __future__ import annotations

import json
import math
import zlib
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Compression = Literal["zlib", "none"]


def write_group(folder: Path) -> None:
    """Make a group, which holds groups and arrays."""
    folder.mkdir(exist_ok=True)
    _write_json(folder / ".zgroup", {"zarr_format": 2})


class RowWriter:
    """Writes an array of known shape from its rows; no more than one chunk of rows is in memory.

    Rows that are never added read as 0: a reader takes the fill value where there is no chunk.
    """

    def __init__(
        self, folder: Path, shape: tuple[int, ...], dtype: str, *, chunk_rows: int, compression: Compression
    ) -> None:
        self._folder, self._shape, self._compression = folder, shape, compression
        self._chunk: NDArray[Any] = np.zeros((chunk_rows, *shape[1:]), dtype)
        self._row = 0
        folder.mkdir()
        _write_json(
            folder / ".zarray",
            {
                "zarr_format": 2,
                "shape": list(shape),
                "chunks": list(self._chunk.shape),
                "dtype": self._chunk.dtype.str,
                "compressor": {"id": "zlib", "level": 1} if compression == "zlib" else None,
                "fill_value": 0,
                "order": "C",
                "filters": None,
            },
        )

    def add(self, row: NDArray[Any]) -> None:
        """Append one row."""
        position = self._row % len(self._chunk)
        self._chunk[position] = row
        self._row += 1
        if position == len(self._chunk) - 1 or self._row == self._shape[0]:
            self._flush()

    def _flush(self) -> None:
        # Chunks at the end have full size too; what lies beyond the shape is not read.
        number = math.ceil(self._row / len(self._chunk)) - 1
        content = self._chunk.tobytes()
        if self._compression == "zlib":
            content = zlib.compress(content, 1)
        name = ".".join([str(number)] + ["0"] * (len(self._shape) - 1))
        (self._folder / name).write_bytes(content)
        self._chunk[:] = 0


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=4, sort_keys=True) + "\n", encoding="utf-8")
