"""The hidden file that a new one is written to, beside its place; what a killed writer left of it goes with the next.

The name says what is being written, and a lock says that its writer lives: so the next one to write the same file finds
what a killed one left, without listing the folder.
"""

from __future__ import annotations

import errno
import hashlib
import os
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pcdata.files.interrupts import shielded
from pcdata.files.locks import lock_open

_WRITERS = 8  # of one file at a time
_LONGEST = 150  # bytes of a name that a hidden name can carry, of the 255 that a file name may have
_FORGOTTEN = 86400.0  # seconds: where there are no locks, a file that nobody has touched for a day has no writer
# Absent on Windows. Without blocking: somebody may have put a FIFO there.
_FLAGS = getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)


@contextmanager
def part_file(target: Path) -> Iterator[Path]:
    """Give an empty hidden file beside ``target``, for this writer alone; it is removed where it is still there.

    Raises:
        OSError: it cannot be made.
    """
    part = descriptor = None
    try:
        with shielded():
            part, descriptor = _claimed(target)
        yield part
    finally:
        with shielded():
            # Once it has been renamed, another writer may have a file of that name.
            if part is not None and (descriptor is None or _is_same(descriptor, part)):
                with suppress(OSError):
                    part.unlink(missing_ok=True)
            if descriptor is not None:
                os.close(descriptor)


def part_name(target: Path, number: int = 0) -> str:
    """Return the hidden name of a writer; it ends as the target does, since libraries go by that."""
    name = os.fsencode(target.name)
    stem = target.name if len(name) <= _LONGEST else hashlib.sha256(name).hexdigest()[:32]
    return f".{stem}.part{number}{target.suffix if len(target.suffix) < 8 else ''}"


def _claimed(target: Path) -> tuple[Path, int | None]:
    """Make the first file that no living writer has, and remove what killed ones left under the other names."""
    claimed = None
    for number in range(_WRITERS):
        part = target.with_name(part_name(target, number))
        if claimed is not None:
            if os.path.lexists(part):
                _remove_dead(part)
            continue
        descriptor = _made(part)
        if descriptor is not None:
            claimed = part, descriptor
    if claimed is None:
        raise FileExistsError(errno.EEXIST, f"{_WRITERS} processes are writing it now", str(target))
    if os.name == "nt":  # an open file cannot be renamed there
        os.close(claimed[1])
        return claimed[0], None
    return claimed


def _made(part: Path) -> int | None:
    """Make and lock a file; None where a living writer has the name."""
    while True:
        try:
            descriptor = os.open(part, os.O_RDWR | os.O_CREAT | os.O_EXCL | _FLAGS, 0o666)
        except FileExistsError:
            if not _remove_dead(part):
                return None
            continue
        if lock_open(descriptor) is not False and _is_same(descriptor, part):
            return descriptor
        os.close(descriptor)  # another writer took it for a dead one's, before it was locked, and removes it


def _remove_dead(part: Path) -> bool:
    """Remove a file whose writer is dead; False where it lives, or nothing is known."""
    try:
        descriptor = os.open(part, os.O_RDWR | _FLAGS)
    except FileNotFoundError:
        return True
    except OSError:  # another user's, a link, a folder
        return False
    try:
        status = os.fstat(descriptor)
        locked = lock_open(descriptor)
        forgotten = locked is None and time.time() - status.st_mtime > _FORGOTTEN
        if not stat.S_ISREG(status.st_mode) or not (locked or forgotten):
            return False
        if _is_same(descriptor, part):
            os.unlink(part)
        return True
    except OSError:
        return False
    finally:
        os.close(descriptor)


def _is_same(descriptor: int, path: Path) -> bool:
    """Say whether a name still means an open file."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.lstat(path))
    except FileNotFoundError:
        return False
