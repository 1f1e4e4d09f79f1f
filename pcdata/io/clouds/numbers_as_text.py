"""Numbers of a given type <-> lines of text, for the ascii encodings of cloud files.

Lines are parsed by blocks of a few megabytes, whole columns at a time, so memory stays a small multiple of the file.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError

_BLOCK = 1 << 22  # bytes of text parsed at once
_ROWS = 1 << 14  # rows formatted at once
_EXACT = float(1 << 53)  # whole numbers below are exact in float64

_LAST = b"-8.2694733815029401e-291"  # a number that no file holds

_SPACE = np.zeros(256, bool)
_SPACE[list(b" \t\n\r\x0b\x0c")] = True
_LINE_END = np.zeros(256, bool)
_LINE_END[list(b"\n\r")] = True
_DIGITS = np.zeros(256, bool)
_DIGITS[list(b"0123456789+-.eEnNaAiIfFtTyY")] = True  # of a number, nan and infinity


class TextLines(NamedTuple):
    """The lines of a block that are not blank: their numbers one after another, and where each line's begin."""

    text: bytes
    values: NDArray[np.float64]  # (words,)
    bounds: NDArray[np.int64]  # (lines + 1,)
    first: int = 0  # lines of the text that come before these


def text_blocks(where: str, body: memoryview) -> Iterator[TextLines]:
    """Parse a text block by block.

    Raises:
        CaptureError: a word is no number.
    """
    start = 0
    while start < len(body):
        text = _whole_lines(body, start)
        start += len(text)
        yield _parsed(where, text)


def table_columns(where: str, names: Sequence[str], dtypes: Sequence[np.dtype], lines: TextLines) -> list[NDArray[Any]]:
    """Return the columns of a block whose lines have one word for each name.

    Raises:
        CaptureError: a line has more or fewer words, or a value does not fit its type.
    """
    wrong = np.flatnonzero(np.diff(lines.bounds) != len(dtypes))
    if len(wrong):
        raise CaptureError(
            f"{where}: a line must follow the header with {len(dtypes)} values, but one has "
            f"{int(np.diff(lines.bounds)[wrong[0]])}: {line_of(lines, int(wrong[0]))!r:.200}"
        )
    table = lines.values.reshape(-1, len(dtypes))
    return [
        typed(f"{where}: {name}", table[:, i], dtype, lambda i=i: [line.split()[i] for line in _texts(lines)])
        for i, (name, dtype) in enumerate(zip(names, dtypes, strict=True))
    ]


def typed(where: str, values: NDArray[np.float64], dtype: np.dtype, words: Any) -> NDArray[Any]:
    """Return parsed numbers in their own type; ``words()`` gives the text of integers that float64 cannot hold.

    Raises:
        CaptureError: a value does not fit the type.
    """
    if dtype.kind == "f":
        with np.errstate(over="ignore"):
            return values.astype(dtype)
    limits = np.iinfo(dtype)
    if dtype.itemsize == 8 and len(values) and not np.abs(values).max() < _EXACT:
        return _exact_integers(where, words(), dtype)
    fits = (values == np.rint(values)) & (values >= limits.min) & (values <= limits.max)
    if not fits.all():
        raise _misfit(where, dtype, f"{values[~fits][0]:.17g}")
    return values.astype(dtype)


def line_of(lines: TextLines, number: int) -> bytes:
    """Return one line of a block, for a message."""
    return _texts(lines)[number].strip()


def format_rows(columns: Sequence[NDArray[Any]]) -> bytes:
    """Write (N,) columns side by side, one line per row, with as many digits as reading back the same floats takes."""
    line = " ".join(_form(column) for column in columns) + "\n"
    parts = []
    for start in range(0, len(columns[0]) if columns else 0, _ROWS):
        rows = zip(*(column[start : start + _ROWS].tolist() for column in columns))
        parts.append("".join([line % row for row in rows]).encode("ascii"))
    return b"".join(parts)


def _texts(lines: TextLines) -> list[bytes]:
    texts = [line for line in lines.text.splitlines() if line.strip()]
    return texts[lines.first : lines.first + len(lines.bounds) - 1]


def _form(column: NDArray[Any]) -> str:
    if column.dtype.kind != "f":
        return "%d"
    return "%.9g" if column.dtype.itemsize == 4 else "%.17g"


def _whole_lines(body: memoryview, start: int) -> bytes:
    """Return about a block of text that ends where a line does."""
    text = bytes(body[start : start + _BLOCK])
    if len(text) < _BLOCK:
        return text
    cut = text.rfind(b"\n") + 1
    while not cut and start + len(text) < len(body):
        text += bytes(body[start + len(text) : start + 2 * len(text)])
        cut = text.rfind(b"\n") + 1
    return text[:cut] if cut else text


def _layout(text: bytes) -> tuple[int, NDArray[np.int64]]:
    """Return the number of words, and the bounds of the lines that have any, in words."""
    raw = np.frombuffer(text, np.uint8)
    if not len(raw):
        return 0, np.zeros(1, np.int64)
    space = _SPACE[raw]
    starts = ~space
    starts[1:] &= space[:-1]
    words = np.flatnonzero(starts)
    ends = np.searchsorted(words, np.flatnonzero(_LINE_END[raw]))
    bounds = np.unique(np.concatenate([[0], ends, [len(words)]]))
    return len(words), bounds.astype(np.int64)


def _parsed(where: str, text: bytes) -> TextLines:
    count, bounds = _layout(text)
    raw = np.frombuffer(text, np.uint8)
    values = None
    if (_DIGITS[raw] | _SPACE[raw]).all():
        try:
            values = np.fromstring(text + b" " + _LAST, np.float64, sep=" ")
        except (ValueError, DeprecationWarning):  # what it says of words that are no numbers depends on the version
            values = None
    # The parser takes "1-2" for two values, and stops at what is no number. Where it got to the number put at the end,
    # every word gave a value or more; as there are as many values as words, each gave one.
    if values is None or len(values) != count + 1 or values[-1] != float(_LAST):
        for word in text.split():
            try:
                float(word)
            except ValueError:
                raise CaptureError(f"{where}: must be numbers, but there is {word!r:.60}") from None
        raise CaptureError(f"{where}: must be numbers in plain notation, separated by blanks")
    return TextLines(text, values[:-1], bounds)


def _exact_integers(where: str, words: Sequence[bytes], dtype: np.dtype) -> NDArray[Any]:
    limits = np.iinfo(dtype)
    try:
        values = [int(word) for word in words]
    except ValueError as error:
        raise _misfit(where, dtype, str(error)) from None
    for value in values:
        if not limits.min <= value <= limits.max:
            raise _misfit(where, dtype, str(value))
    return np.array(values, dtype=dtype)


def _misfit(where: str, dtype: np.dtype, found: str) -> CaptureError:
    return CaptureError(f"{where}: values must be numbers of type {dtype.name}, got {found:.60}")
