"""Folders that appear complete or not at all: written under a hidden name beside their own, then renamed."""

from __future__ import annotations

import os
import platform
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pcdata.errors import CacheError


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
    created = [parent for parent in folder.parents if not parent.exists()]
    try:
        try:
            partial.mkdir(parents=True)
        except OSError as error:
            raise CacheError(f"{folder}: cannot write there: {error}") from error
        yield partial
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        with suppress(OSError):  # not empty: somebody else uses it
            for parent in created:
                parent.rmdir()
        raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _neighbour(folder: Path, what: str) -> Path:
    return folder.with_name(f".{folder.name}.{what}-{platform.node()}-{os.getpid()}-{uuid.uuid4().hex[:8]}")
