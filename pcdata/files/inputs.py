"""Which input files were read, and whether they are still what was read: long work must not mix two states of them.

Small files, such as calibrations, poses and lists, are compared by content: saved again without a change they are what
they were, and changed without a trace in size and time they are not. Larger ones are compared by size, time and inode.
"""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import BinaryIO, NamedTuple

from pcdata.errors import CaptureError

_BLOCK = 1 << 22  # bytes
_SMALL = 1 << 16  # bytes: reading so many again takes no longer than to open the file


class _State(NamedTuple):
    """What a file is compared by."""

    size: int
    marks: tuple[int, int]  # time of the last change in ns, inode
    digest: bytes | None  # of a small file's content


class Inputs:
    """Files by absolute path, and the state in which each was first read."""

    def __init__(self) -> None:
        self._first: dict[str, _State] = {}
        self._unchecked: list[str] = []

    def note(self, path: str | os.PathLike[str], file: BinaryIO) -> None:
        """Remember a file that is being read; its position stays at the start."""
        name = os.path.abspath(path)
        if name not in self._first:
            self._first[name] = _state(file)
        self._unchecked.append(name)

    def add(self, other: Inputs) -> None:
        """Remember what others have read too."""
        for name, state in other._first.items():
            self._first.setdefault(name, state)

    def states(self) -> list[list[str | int]]:
        """Return what the files are compared by, without their folders: name, size, and content or time."""
        return [[os.path.basename(name), *_told(state)] for name, state in self._first.items()]

    def check_latest(self, where: str) -> None:
        """Require that the files read since the last call are as they were when they were first read.

        Raises:
            CaptureError: names the file that changed.
        """
        names, self._unchecked = self._unchecked, []
        self._check(where, names)

    def check(self, where: str) -> None:
        """Require that all files are as they were when they were first read.

        Raises:
            CaptureError: names the file that changed.
        """
        self._check(where, self._first)

    def _check(self, where: str, names: list[str] | dict[str, _State]) -> None:
        for name in names:
            try:
                changed = not _is_unchanged(name, self._first[name])
                what = "was changed"
            except FileNotFoundError:
                changed, what = True, "was removed"
            except OSError:  # a network that is away for a moment changes nothing
                continue
            if changed:
                raise CaptureError(
                    f"{where}: {name} {what} after it was first read, so the result would mix two states of the "
                    "captures; let them rest, then open them and start again"
                )


_recording: ContextVar[tuple[Inputs, ...]] = ContextVar("recording", default=())


@contextmanager
def recording(inputs: Inputs) -> Iterator[None]:
    """Note every file that this thread reads through :func:`pcdata.files.opening.open_input` in the block."""
    token = _recording.set((*_recording.get(), inputs))
    try:
        yield
    finally:
        _recording.reset(token)


def note_input(path: str | os.PathLike[str], file: BinaryIO) -> None:
    """Tell whoever records that a file is being read."""
    for inputs in _recording.get():
        inputs.note(path, file)


def states_of(paths: Iterable[str | os.PathLike[str]], *, by_content: bool = False) -> list[list[str | int]]:
    """Return what files are compared by, as they are now; of one that is missing or no file, nothing.

    ``by_content`` reads them all: otherwise large ones are compared by size and time.
    """
    found: list[list[str | int]] = []
    for path in paths:
        try:
            status = os.stat(path)
            is_file = stat.S_ISREG(status.st_mode)
            if not is_file or (status.st_size > _SMALL and not by_content):
                found.append([status.st_size, status.st_mtime_ns])
                continue
            with open(path, "rb") as file:
                found.append([status.st_size, _hash_of(file)] if by_content else _told(_state(file)))
        except OSError:
            found.append([])
    return found


def _hash_of(file: BinaryIO) -> str:
    total = hashlib.sha256()
    while block := file.read(_BLOCK):
        total.update(block)
    return total.hexdigest()


def _told(state: _State) -> list[str | int]:
    return [state.size, state.marks[0] if state.digest is None else state.digest.hex()]


def _state(file: BinaryIO) -> _State:
    status = os.fstat(file.fileno())
    digest = None
    if status.st_size <= _SMALL:
        digest = hashlib.sha256(file.read(_SMALL + 1)).digest()
        file.seek(0)
    return _State(status.st_size, (status.st_mtime_ns, status.st_ino), digest)


def _is_unchanged(name: str, first: _State) -> bool:
    status = os.stat(name)
    if status.st_size != first.size or not stat.S_ISREG(status.st_mode):
        return False
    if first.digest is None:
        return (status.st_mtime_ns, status.st_ino) == first.marks
    with open(name, "rb") as file:
        return _state(file).digest == first.digest
