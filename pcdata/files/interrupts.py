"""Signals that ask a process to end, and the short work that they may not cut in two."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any

ENDING = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)  # Windows has no SIGHUP


class shielded:  # used like a function: with shielded(): ...
    """Hold back the signals that would raise in the middle of a commit or a cleanup; the first is delivered after it.

    While a ``KeyboardInterrupt`` is already being handled, more of them are dropped: it is what they ask for. A signal
    whose action is the system's (``SIGTERM`` in most programs) stays that. Python runs handlers in the main thread
    alone, so in another thread there is nothing to hold back.
    """

    def __init__(self) -> None:
        self._previous: dict[int, Callable[[int, FrameType | None], Any]] = {}
        self._held: list[int] = []

    def __enter__(self) -> None:
        if threading.current_thread() is not threading.main_thread():
            return
        try:
            for number in ENDING:
                handler = signal.getsignal(number)
                if callable(handler):
                    self._previous[number] = handler
                    signal.signal(number, self._hold)
        except BaseException:  # one that was not held back yet
            self._restore()
            raise

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._restore()
        if self._held and not isinstance(error or sys.exc_info()[1], KeyboardInterrupt):
            self._previous[self._held[0]](self._held[0], None)

    def _restore(self) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _hold(self, number: int, frame: FrameType | None) -> None:
        self._held.append(number)


class deaf_children:  # used like a function: with deaf_children(): ...
    """Let processes started in the block ignore Ctrl-C, which a terminal sends to all: their parent ends them."""

    def __enter__(self) -> None:
        # A blocked signal stays blocked in a child, after fork and after exec; this process hears it at the end.
        self._before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if os.name == "posix" else None

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, self._before)
