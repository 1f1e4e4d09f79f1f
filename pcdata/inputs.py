"""Which input files were read, and whether they are still what was read: long work must not mix two states of them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from pcdata.errors import CaptureError

State = tuple[int, int, int]  # size, time of the last change in ns, inode


class Inputs:
    """Files by absolute path, and the state in which each was first read."""

    def __init__(self) -> None:
        self._first: dict[str, State] = {}
        self._unchecked: list[str] = []

    def note(self, path: str | os.PathLike[str], status: os.stat_result) -> None:
        """Remember a file that is being read."""
        name = os.path.abspath(path)
        self._first.setdefault(name, _state(status))
        self._unchecked.append(name)

    def add(self, other: Inputs) -> None:
        """Remember what others have read too."""
        for name, state in other._first.items():
            self._first.setdefault(name, state)

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

    def _check(self, where: str, names: list[str] | dict[str, State]) -> None:
        for name in names:
            try:
                now: State | None = _state(os.stat(name))
            except FileNotFoundError:
                now = None
            except OSError:  # a network that is away for a moment changes nothing
                continue
            if now != self._first[name]:
                what = "was removed" if now is None else "was changed"
                raise CaptureError(
                    f"{where}: {name} {what} after it was first read, so the result would mix two states of the "
                    "captures; let them rest, then open them and start again"
                )


_recording: ContextVar[tuple[Inputs, ...]] = ContextVar("recording", default=())


@contextmanager
def recording(inputs: Inputs) -> Iterator[None]:
    """Note every file that this thread reads through :func:`pcdata.files.open_input` in the block."""
    token = _recording.set((*_recording.get(), inputs))
    try:
        yield
    finally:
        _recording.reset(token)


def note_input(path: str | os.PathLike[str], status: os.stat_result) -> None:
    """Tell whoever records that a file is being read."""
    for inputs in _recording.get():
        inputs.note(path, status)


def _state(status: os.stat_result) -> State:
    return status.st_size, status.st_mtime_ns, status.st_ino
