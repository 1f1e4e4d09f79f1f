"""Locks on files and folders that end with the process that holds them, however it ends."""

from __future__ import annotations

import os
import sys

if sys.platform != "win32":
    import fcntl


def try_lock(path: str | os.PathLike[str]) -> tuple[int | None, bool]:
    """Open and lock a file or folder: the descriptor that holds it, or None, and whether another process does.

    (None, False): it cannot be opened, or there are no locks here.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except OSError:
        return None, False
    locked = lock_open(descriptor)
    if not locked:
        os.close(descriptor)
        return None, locked is False
    return descriptor, False


def lock_open(descriptor: int) -> bool | None:
    """Lock an open file: True = now held, False = another holds it, None = there are no locks here."""
    if sys.platform == "win32":
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return False if isinstance(error, BlockingIOError) else None
    return True


def release(descriptor: int | None) -> None:
    """Give up what :func:`try_lock` took; None = it took nothing."""
    if descriptor is not None:
        os.close(descriptor)
