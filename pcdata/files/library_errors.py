"""Libraries that read files fail in ways of their own; here they become one typed error that names the file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pcdata.errors import CaptureError, PcdataError, add_note
from pcdata.files.opening import told_at


@contextmanager
def read_by_library(where: str, path: Path, what: str) -> Iterator[None]:
    """Name the file in whatever goes wrong within.

    Args:
        where: for messages.
        path: the file.
        what: it must be, in words.

    Raises:
        CaptureError: the library cannot read it.
        PcdataError: raised within; the file is added to its notes.
    """
    try:
        yield
    except PcdataError as error:
        add_note(error, f"while reading {path}")
        raise
    except Exception as error:  # Arrow's and FFmpeg's errors are of many types, some of them of Python's own
        raise CaptureError(
            f"{told_at(where, path)}: not a readable {what}: {type(error).__name__}: {str(error)[:300]}"
        ) from error
