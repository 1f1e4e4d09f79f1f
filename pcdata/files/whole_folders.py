"""Folders that appear complete or not at all: written under a hidden name beside their own, then renamed.

Nothing that somebody else made is ever removed: a name that was free is taken with a rename that fails where it is no
longer free, and what is replaced is examined once more before it is deleted file by file.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pcdata.errors import CacheError, write_fault
from pcdata.files.exchange import exchange
from pcdata.files.interrupts import shielded
from pcdata.files.scratch import (
    REPLACED,
    RETIRED,
    Note,
    hidden_name,
    hidden_neighbors,
    retired_of,
    scratch_beside,
    silent,
)
from pcdata.files.syncing import sync_folder
from pcdata.files.urls import url_hint

# The file at the top of a folder that says what it is; without it nobody could tell what a killed removal left.
DATASET, EXPORT = "dataset.json", "pcdata_export.json"
INDEX = "index"  # the folder of a dataset that says what else is in it
Owned = Callable[[Path], None]  # raises CacheError where a folder holds anything that deleting it would lose


def never_owned(folder: Path) -> None:
    """Of a folder that nothing is known about, everything is somebody else's."""
    raise CacheError(f"{folder} holds files that were not made here")


@contextmanager
def complete_or_nothing(
    folder: Path, *, overwrite: bool = False, owned: Owned = never_owned, note: Note = silent
) -> Iterator[Path]:
    """Give a hidden neighbor to write into; rename it into place at the end, remove it on any failure.

    Args:
        folder: the name that the new folder gets; nothing or an empty folder may be there.
        overwrite: also an old folder that ``owned`` accepts may be there. It stays until the new one is complete.
        owned: raises unless a folder holds only what may be deleted; called again before anything is.
        note: told what killed writers had left and what became of it.

    Raises:
        CacheError: the name is taken, before or after the work; somebody else is writing it; it cannot be written.
    """
    check_replaceable(folder, overwrite, owned)
    with scratch_beside(folder, alone=True, note=note) as partial:
        replaced = prepared(folder, overwrite, owned, note)
        yield partial
        put_into_place(partial, folder, replaced, owned, note)


def check_replaceable(folder: Path, overwrite: bool, owned: Owned) -> None:
    """Require that a name is free, or that what is there may be replaced.

    Raises:
        CacheError: it is neither.
    """
    if is_free(folder):
        return
    owned(folder)  # first: what may never be replaced is not advised to be
    if not overwrite:
        raise CacheError(f"{folder} exists already; choose another folder, or allow overwriting (--overwrite)")


def prepared(folder: Path, overwrite: bool, owned: Owned, note: Note) -> object:
    """Put right what killed overwrites left at a name; return what is there, for :func:`put_into_place`.

    Only the sole writer may.

    Raises:
        CacheError: as for :func:`check_replaceable`.
    """
    restore_retired(folder, owned, note)
    check_replaceable(folder, overwrite, owned)
    return None if is_free(folder) else _identity(folder)


def is_free(folder: Path) -> bool:
    """Say whether nothing is under a name, or an empty folder."""
    try:
        os.lstat(folder)
        return folder.is_dir() and not os.listdir(folder)
    except FileNotFoundError:
        if ":" in str(folder) and (hint := url_hint(folder)):
            raise CacheError(hint) from None
        return True
    except OSError as error:  # a name that is too long, a file where a folder is to be
        raise CacheError(f"{folder}: cannot be written there: {write_fault(error)}") from error


def restore_retired(folder: Path, owned: Owned, note: Note) -> None:
    """Put back, or remove, what an overwrite that was killed had set aside; only the sole writer may."""
    for retired in retired_of(folder):
        if not os.path.lexists(folder):
            try:
                os.rename(retired, folder)
            except OSError as error:
                raise CacheError(
                    f"{folder}: an overwrite was killed and left what was there as {retired}, which cannot be renamed "
                    f"back: {error}"
                ) from error
            note(f"restored {folder}, which a killed overwrite had set aside as {retired.name}")
    with suppress(OSError):  # a folder that may be written but not listed
        for old in retired_of(folder) + hidden_neighbors(folder, REPLACED):
            try:
                remove_owned(old, owned)
            except (CacheError, OSError) as error:
                note(f"{old} was replaced by an overwrite that was killed and is left alone: {error}")
            else:
                note(f"removed {old.name}, which an overwrite that was killed had replaced")


def remove_owned(folder: Path, owned: Owned) -> None:
    """Delete a folder that holds only what ``owned`` accepts; a file that comes meanwhile stays, in its folder.

    A dataset's index and the files at the top go last, and of them the one that says what the folder is, so that what
    is left of a removal that was killed can be removed too.
    """
    if not any(folder.iterdir()):
        os.rmdir(folder)
        return
    below: list[tuple[str, list[str], list[str]]] = list(os.walk(folder, topdown=False))
    owned(folder)
    below.sort(key=lambda walked: (walked[0] == str(folder)) * 2 + (walked[0] == str(folder / INDEX)))
    for place, folders, files in below:
        files.sort(key=lambda name: name in (DATASET, EXPORT))
        for name in files + [name for name in folders if os.path.islink(os.path.join(place, name))]:
            os.unlink(os.path.join(place, name))
        os.rmdir(place)


def _identity(folder: Path) -> object:
    """Return what tells a folder from another of the same name."""
    with suppress(OSError):
        about = folder.stat()
        files = [(entry.name, entry.stat()) for entry in os.scandir(folder) if entry.is_file(follow_symlinks=False)]
        return about.st_dev, about.st_ino, sorted((name, file.st_ino, file.st_mtime_ns) for name, file in files)
    return None


def put_into_place(partial: Path, folder: Path, replaced: object, owned: Owned, note: Note) -> None:
    """Give a complete folder its name, at once; what was there before is deleted.

    Args:
        partial: the folder, on the same file system.
        folder: the name.
        replaced: what :func:`prepared` found there.
        owned: raises unless a folder holds only what may be deleted.
        note: told what is left.

    Raises:
        CacheError: something else is there now, or it cannot be renamed.
    """
    with shielded():
        _put_into_place(partial, folder, replaced, owned, note)


def _put_into_place(partial: Path, folder: Path, replaced: object, owned: Owned, note: Note) -> None:
    try:
        if is_free(folder):
            rename_to_free(partial, folder)
        else:
            if replaced is None or _identity(folder) != replaced:
                raise CacheError(
                    f"{folder}: somebody else made or changed it while this was written, so it is left as it is; "
                    "choose another folder"
                )
            owned(folder)
            _remove_replaced(_swap(partial, folder), folder, owned, note)
        sync_folder(folder.parent)
    except OSError as error:
        raise CacheError(f"{folder}: cannot be put into place: {write_fault(error)}") from error


def rename_to_free(partial: Path, folder: Path) -> None:
    """Rename a folder to a name that nothing has, or an empty folder: POSIX lets a folder replace nothing else."""
    if os.name == "nt":
        with suppress(FileNotFoundError):
            os.rmdir(folder)  # fails unless empty
    try:
        os.rename(partial, folder)
    except OSError as error:
        if os.path.lexists(folder):
            raise CacheError(
                f"{folder}: somebody else made it while this was written, so it is left as it is; choose another folder"
            ) from error
        raise


def _swap(partial: Path, folder: Path) -> Path:
    """Put the new folder under the name; return where the old one is."""
    replaced = folder.with_name(hidden_name(folder, REPLACED))
    if exchange(partial, folder):  # at no time is there nothing under the name
        try:
            os.rename(partial, replaced)
        except BaseException:
            exchange(partial, folder)
            raise
        return replaced
    retired = folder.with_name(hidden_name(folder, RETIRED))
    os.rename(folder, retired)
    try:
        rename_to_free(partial, folder)
    except BaseException:
        if not os.path.lexists(folder):
            os.rename(retired, folder)
        raise
    os.rename(retired, replaced)
    return replaced


def _remove_replaced(replaced: Path, folder: Path, owned: Owned, note: Note) -> None:
    """Delete what was replaced, unless a file was put into it at the last moment."""
    try:
        remove_owned(replaced, owned)
    except (CacheError, OSError) as error:
        note(f"what was replaced at {folder} is not deleted whole, the rest is kept as {replaced}: {error}")
