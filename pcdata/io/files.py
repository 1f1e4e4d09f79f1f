"""Opening the files of a capture: every way that fails is one typed error that names the file."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError

MAX_TEXT_BYTES = 1 << 20  # a calibration or pose file holds a few hundred bytes


def existing_file(where: str, path: str | os.PathLike[str], *, max_bytes: int) -> Path:
    """Return the path of a regular, non-empty file of at most ``max_bytes``.

    Raises:
        CaptureError: it is missing, a folder, empty, unreadable or larger.
    """
    file = Path(path)
    try:
        if not file.exists():
            raise CaptureError(f"{where}: {file}: no such file; check the path (relative to {Path.cwd()})")
        if not file.is_file():
            raise CaptureError(f"{where}: {file}: must be a file, but it is a folder or a device")
        size = file.stat().st_size
    except OSError as error:
        raise CaptureError(f"{where}: {file}: cannot be examined: {error}") from error
    if size == 0:
        raise CaptureError(f"{where}: {file}: the file is empty (0 bytes); was the copy or download interrupted?")
    if size > max_bytes:
        raise CaptureError(f"{where}: {file}: has {size} bytes, more than the limit of {max_bytes} for this kind")
    return file


def read_bytes(where: str, path: str | os.PathLike[str], *, max_bytes: int) -> bytes:
    """Return the whole content of a file that passes :func:`existing_file`."""
    file = existing_file(where, path, max_bytes=max_bytes)
    try:
        return file.read_bytes()
    except OSError as error:
        raise CaptureError(f"{where}: {file}: cannot be read: {error}") from error


def read_text(where: str, path: str | os.PathLike[str]) -> str:
    """Return the content of a small UTF-8 text file (a byte order mark is dropped)."""
    try:
        return read_bytes(where, path, max_bytes=MAX_TEXT_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise CaptureError(f"{where}: {path}: must be UTF-8 text, but it is not: {error}") from error


def map_npy(where: str, path: str | os.PathLike[str], *, max_bytes: int) -> NDArray[Any]:
    """Return the array of a ``.npy`` file, read-only and still on disk; objects are never unpickled.

    Mapped, so that a header that promises more than the file holds fails before anything is allocated.
    """
    file = existing_file(where, path, max_bytes=max_bytes)
    try:
        return np.lib.format.open_memmap(file, mode="r")
    except (
        OSError, ValueError, EOFError, SyntaxError, TypeError, MemoryError, OverflowError, RecursionError, TokenError,
    ) as error:  # fmt: skip  # NumPy parses the header as Python source text
        raise CaptureError(f"{where}: {file}: not a readable .npy file of numbers: {error}") from error


@contextmanager
def replacing(where: str, path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary name beside ``path`` to write to; on success it becomes ``path`` at once, else it is removed."""
    target = Path(path)
    if not target.parent.is_dir():
        raise CaptureError(f"{where}: {target}: the folder {target.parent} does not exist; create it first")
    temporary = target.with_name(f".{target.name}.{uuid.uuid4().hex}.part")
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        raise CaptureError(f"{where}: {target}: cannot be written: {error}") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
