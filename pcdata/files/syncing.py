"""Files and names forced to disk, where the system can."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path


def sync_file(path: Path) -> None:
    """Force the content of a file to disk.

    Raises:
        OSError: the disk is full, which some file systems say only now.
    """
    descriptor = os.open(path, os.O_RDWR | getattr(os, "O_BINARY", 0))
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_folder(folder: Path) -> None:
    """Force the names in a folder to disk; Windows and some file systems cannot."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def sync_tree(folder: Path) -> dict[str, int]:
    """Force everything below a folder to disk; return the size of every file by its path within the folder.

    Raises:
        OSError: as for :func:`sync_file`.
    """
    sizes = {}
    for place, _, names in os.walk(folder, topdown=False):
        for name in names:
            path = Path(place, name)
            sync_file(path)
            sizes[path.relative_to(folder).as_posix()] = path.stat().st_size
        sync_folder(Path(place))
    return dict(sorted(sizes.items()))
