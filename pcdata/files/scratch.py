"""Hidden folders to write in beside the place where the result goes, and what killed processes left of theirs.

A scratch folder carries the machine and process that made it in its name, and a lock that ends with that process
however it ends. So a folder whose owner lives is never touched, and one whose owner is dead is removed by the next
writer.
"""

from __future__ import annotations

import glob
import hashlib
import os
import platform
import shutil
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

from pcdata.errors import CacheError, write_fault
from pcdata.files.interrupts import shielded
from pcdata.files.locks import release, try_lock

Note = Callable[[str], None]  # tell the user what is no error

PARTIAL = "partial"  # what is being written
RETIRED = "retired"  # what was under the name, until the new folder is: to be put back
REPLACED = "replaced"  # what was under the name before the new folder: to be deleted

_FRESH = 60.0  # seconds: a folder so new may not be locked yet
_LOCKING = 0.2  # seconds from making a folder to locking it, at most
_LONGEST = 150  # bytes of a name that hidden names can carry, of the 255 that a file name may have


def silent(text: str) -> None:
    """Tell nobody."""


@contextmanager
def scratch_beside(folder: Path, *, alone: bool = False, note: Note = silent) -> Iterator[Path]:
    """Give an empty hidden folder on the file system of ``folder``; it is removed at the end, with what is still in it.

    Args:
        folder: the name to write beside; parents that are missing are made, and removed again on failure.
        alone: refuse where another process has such a folder now.
        note: told what was found of killed processes.

    Raises:
        CacheError: nothing can be written there, or another process writes there.
    """
    partial = folder.with_name(hidden_name(folder, PARTIAL))
    created = [parent for parent in folder.parents if not parent.exists()]
    lock: int | None = None
    try:
        try:
            partial.mkdir(parents=True)
        except OSError as error:
            raise CacheError(f"{folder}: cannot write there: {write_fault(error)}") from error
        lock, _ = try_lock(partial)
        _settle_others(folder, partial, alone, note)
        yield partial
    except BaseException:
        with shielded():
            shutil.rmtree(partial, ignore_errors=True)
            with suppress(OSError):  # not empty: somebody else uses it
                for parent in created:
                    parent.rmdir()
        raise
    finally:
        with shielded():
            shutil.rmtree(partial, ignore_errors=True)
            release(lock)


@contextmanager
def claimed(path: Path, note: Note = silent) -> Iterator[Path | None]:
    """Claim what a name stands for, with a file beside it that is locked; give the claim of who came first, if any.

    Claims of dead processes are removed. Where the file system has no locks, a process of this machine counts as long
    as it runs, and of one of another machine nothing is known: that is noted, and does not hinder.

    Raises:
        CacheError: no file can be made there.
    """
    own = path.with_name(f"{path.name}.{_maker()}")
    lock: int | None = None
    try:
        try:
            with open(own, "xb"):
                pass
        except OSError as error:
            raise CacheError(f"{path.parent}: cannot write there: {write_fault(error)}") from error
        lock, _ = try_lock(own)
        first = None
        for other in sorted(path.parent.glob(glob.escape(path.name) + ".*")):
            made_by = other.name.removeprefix(f"{path.name}.")
            if other == own:
                continue
            state = _settled(other, made_by)
            if state == "dead":
                note(f"a process that wrote it before was killed ({made_by.rpartition('-')[0]})")
            elif state == "unknown":
                note(f"{other} was left by a process of which nothing is known here; remove it if that has ended")
            elif _made(made_by) < _made(own.name):  # of two at once, the first goes on
                first = other
        yield first
    finally:
        with shielded():
            with suppress(OSError):
                os.unlink(own)
            release(lock)


def living_claims(folder: Path) -> list[Path]:
    """Return the claims in a folder whose processes live, this one's too."""
    try:
        claims = sorted(folder.iterdir())
    except OSError:
        return []
    return [one for one in claims if _settled(one, one.name.partition(".")[2]) == "alive"]


def _settled(claim: Path, made_by: str) -> str:
    """Say what became of the process of a claim; a dead one's is removed."""
    state, lock = _owner(claim, made_by)
    if state == "dead":
        with suppress(OSError):
            os.unlink(claim)
    release(lock)
    return state


def hidden_folder(folder: Path, what: str) -> Path:
    """Return the one hidden neighbor of a kind that a folder has, whoever made it."""
    return folder.with_name(_prefix(folder, what).removesuffix("-"))


def hidden_name(folder: Path, what: str) -> str:
    """Return a new name for a hidden neighbor of a folder; it says who made it, and when."""
    return _prefix(folder, what) + _maker()


def _maker() -> str:
    """Return what a name says of who made it, and when."""
    return f"{platform.node()}-{os.getpid()}-{time.time_ns():x}{uuid.uuid4().hex[:4]}"


def retired_of(folder: Path) -> list[Path]:
    """Return what killed overwrites of a folder had set aside, the newest first."""
    with suppress(OSError):
        return sorted(hidden_neighbors(folder, RETIRED), key=lambda path: path.stat().st_mtime_ns, reverse=True)
    return []


def hidden_neighbors(folder: Path, what: str) -> list[Path]:
    """Return the hidden neighbors of one kind that a folder has."""
    return sorted(folder.parent.glob(glob.escape(_prefix(folder, what)) + "*"))


def _prefix(folder: Path, what: str) -> str:
    if not folder.name:
        raise CacheError(f"{folder} is the root of a disk, beside which nothing can be written; name a folder in it")
    name = os.fsencode(folder.name)
    return f".{folder.name if len(name) <= _LONGEST else hashlib.sha256(name).hexdigest()[:32]}.{what}-"


def _settle_others(folder: Path, own: Path, alone: bool, note: Note) -> None:
    """Remove what dead processes left; refuse to be the second writer where only one may be."""
    try:
        others = [path for path in hidden_neighbors(folder, PARTIAL) if path != own]
    except OSError:  # a folder that may be written but not listed
        return
    for other in others:
        made_by = other.name.removeprefix(_prefix(folder, PARTIAL))
        state, lock = _owner(other, made_by)
        if state == "dead":
            shutil.rmtree(other, ignore_errors=True)
            note(f"removed {other.name}, which a killed process had left")
        elif alone and state == "alive" and _made(made_by) < _made(own.name):  # of two at once, the first goes on
            raise CacheError(
                f"{folder}: another process writes it now (see {other}); wait until that ends, or choose another folder"
            )
        elif alone and state == "unknown":
            note(f"{other} was left by a process of which nothing is known here; remove it if that has ended")
        release(lock)


def _made(name: str) -> str:
    """Return the part of a name that grows with time."""
    return name.rsplit("-", 1)[-1]


def _owner(scratch: Path, made_by: str) -> tuple[Literal["alive", "dead", "unknown"], int | None]:
    """Say what became of the process that made a scratch folder; of a dead one the lock is taken over."""
    try:
        node, pid = made_by.rsplit("-", 2)[:2]
        here, number = node == platform.node(), int(pid)
    except ValueError:
        return "unknown", None
    if not here:
        # Whether locks reach across machines depends on the file system: one that is held is sure, a free one is not.
        lock, held = try_lock(scratch)
        release(lock)
        return ("alive" if held else "unknown"), None
    deadline = time.monotonic() + _LOCKING
    while True:
        lock, held = try_lock(scratch)
        if held:
            return "alive", None
        if not _runs(number):
            return "dead", lock
        if lock is None:  # no locks here: the process alone tells
            return "alive", None
        with suppress(OSError):
            if time.time() - scratch.stat().st_mtime > _FRESH:  # another process has the number now
                return "dead", lock
        os.close(lock)
        if time.monotonic() > deadline:
            return "unknown", None
        time.sleep(_LOCKING / 10)


def _runs(pid: int) -> bool:
    """Say whether a process of this machine may be running."""
    if sys.platform == "win32":  # there, signal 0 would end it
        return True
    with suppress(OSError):
        # Killed, but not yet collected by its parent: "123 (name) Z ...", where the name may hold anything.
        if Path(f"/proc/{pid}/stat").read_bytes().rsplit(b")", 1)[1].split()[0] == b"Z":
            return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # another user's
        return True
    return True
