"""Numbers of a given type <-> words of text, for the ascii encodings of cloud files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError


def parse_words(where: str, words: NDArray[Any], dtype: np.dtype) -> NDArray[Any]:
    """Turn an object array of byte strings into numbers of ``dtype``, any shape.

    Raises:
        CaptureError: a word is no number, or one that the type cannot hold.
    """
    try:
        if dtype.kind == "f":
            with np.errstate(over="ignore"):
                return words.astype(np.float64).astype(dtype)
        # Through Python integers: exact for 64 bits, and no wrap-around.
        values = [int(word) for word in words.ravel().tolist()]
        limits = np.iinfo(dtype)
        if values and not limits.min <= min(values) <= max(values) <= limits.max:
            raise ValueError(f"{min(values)} .. {max(values)} does not fit")
        return np.array(values, dtype=dtype).reshape(words.shape)
    except ValueError as error:
        raise CaptureError(f"{where}: values must be numbers of type {dtype.name}: {error}") from error


def format_rows(columns: Sequence[NDArray[Any]]) -> bytes:
    """Write (N,) columns side by side, one line per row, with as many digits as reading back the same floats takes."""
    return "".join(" ".join(row) + "\n" for row in zip(*map(_words, columns))).encode("ascii")


def _words(column: NDArray[Any]) -> list[str]:
    if column.dtype.kind != "f":
        return list(map(str, column.tolist()))
    digits = 9 if column.dtype.itemsize == 4 else 17
    return [f"{value:.{digits}g}" for value in column.tolist()]
