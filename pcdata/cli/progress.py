"""Progress of a long command, and the signals that end it."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, ClassVar


@contextmanager
def signals_interrupt() -> Iterator[None]:
    """Let a polite kill clean up like Ctrl-C; Python allows that in the main thread only."""
    Progress.interrupted = False
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    # One that is ignored (nohup, a job in the background) stays so.
    numbers = [n for n in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(n) is not signal.SIG_IGN]
    previous = {number: signal.signal(number, _interrupt) for number in numbers}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


def _interrupt(number: int, frame: FrameType | None) -> None:
    Progress.interrupted = True
    raise KeyboardInterrupt


class Progress:
    """A bar on a terminal, plain lines elsewhere; also the place where a lost Ctrl-C is heard."""

    interrupted: ClassVar[bool] = False

    def __init__(self, what: str) -> None:
        self.what = what
        self.bar: Any = None
        self.started = time.perf_counter()

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.close()

    def __call__(self, done: int, total: int, sample_id: str) -> None:
        """Show that ``done`` of ``total`` samples are finished."""
        if self.interrupted:  # it was raised inside a destructor or a callback, where Python drops exceptions
            raise KeyboardInterrupt
        if not sys.stderr.isatty():
            print(f"{self.what} {done}/{total} {sample_id} {time.perf_counter() - self.started:.1f} s", file=sys.stderr)
            return
        if self.bar is None:
            from tqdm import tqdm

            self.bar = tqdm(total=total, desc=self.what, unit="sample", file=sys.stderr)
        self.bar.set_postfix_str(sample_id)
        self.bar.update(done - self.bar.n)
