"""Folders that appear complete or not at all: written under a hidden name beside their own, then renamed."""

from __future__ import annotations

import glob
import os
import platform
import shutil
import sys
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pcdata.errors import CacheError

if sys.platform != "win32":
    import fcntl

_FRESH = 60.0  # seconds: a folder so new may not be locked yet


@contextmanager
def complete_or_nothing(folder: Path) -> Iterator[Path]:
    """Give a hidden neighbour to write into; rename it into place at the end, remove it on any failure.

    What was under the name before stays until the new folder is complete, and comes back if the renaming fails.
    """
    retired = _neighbour(folder, "retired")
    try:
        with scratch_beside(folder) as partial:
            yield partial
            try:
                if folder.exists():
                    os.replace(folder, retired)
                os.replace(partial, folder)
            except OSError as error:
                raise CacheError(f"{folder}: cannot be put into place: {error}") from error
    except BaseException:
        if retired.exists() and not folder.exists():  # stopped between the two renames
            os.replace(retired, folder)
        raise
    finally:
        shutil.rmtree(retired, ignore_errors=True)


@contextmanager
def scratch_beside(folder: Path) -> Iterator[Path]:
    """Give an empty hidden folder on the file system of ``folder``; it is removed at the end, with what is still in it.

    Raises:
        CacheError: nothing can be written there.
    """
    partial = _neighbour(folder, "partial")
    _remove_abandoned(folder)
    created = [parent for parent in folder.parents if not parent.exists()]
    try:
        try:
            partial.mkdir(parents=True)
        except OSError as error:
            raise CacheError(f"{folder}: cannot write there: {error}") from error
        with _in_use(partial):
            yield partial
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        with suppress(OSError):  # not empty: somebody else uses it
            for parent in created:
                parent.rmdir()
        raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)


@contextmanager
def _in_use(scratch: Path) -> Iterator[None]:
    """Hold a lock on a folder that ends with this process, however that ends."""
    lock = _locked(scratch)
    try:
        yield
    finally:
        if lock is not None:
            os.close(lock)


def _locked(scratch: Path) -> int | None:
    """Lock a folder; None if another process holds it, or locks do not work there."""
    if sys.platform == "win32":  # nothing is locked there, so nothing counts as abandoned
        return None
    try:
        descriptor = os.open(scratch, os.O_RDONLY)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def _remove_abandoned(folder: Path) -> None:
    """Remove what earlier writers of ``folder`` left behind that were killed on this machine."""
    with suppress(OSError):
        for scratch in folder.parent.glob(glob.escape(f".{folder.name}.partial-{platform.node()}-") + "*"):
            if time.time() - scratch.stat().st_mtime > _FRESH and (lock := _locked(scratch)) is not None:
                shutil.rmtree(scratch, ignore_errors=True)
                os.close(lock)


def _neighbour(folder: Path, what: str) -> Path:
    return folder.with_name(f".{folder.name}.{what}-{platform.node()}-{os.getpid()}-{uuid.uuid4().hex[:8]}")
