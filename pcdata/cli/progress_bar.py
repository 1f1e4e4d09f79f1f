"""Progress of a long command."""

from __future__ import annotations

import sys
import time
from typing import Any

from pcdata.cli import signals
from pcdata.cli.printable import printable, terminal

_SELDOM = 10.0  # seconds between two plain lines, which a log keeps


class ProgressBar:
    """A bar on a terminal, plain lines elsewhere; also the place where a lost Ctrl-C is heard."""

    def __init__(self, what: str, *, unit: str = "sample") -> None:
        self.what = what
        self.unit = unit
        self.bar: Any = None
        self.started = self.told = time.perf_counter()
        self.first = 0, self.started  # how many were done when the first was told, and when that was
        self.done_before = -1  # by a command that was stopped; -1: not known yet

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.close()

    def __call__(self, done: int, total: int, sample_id: str) -> None:
        """Show that ``done`` of ``total`` samples are finished."""
        if signals.current.first is not None:  # raised inside a destructor or a callback, where Python drops exceptions
            raise KeyboardInterrupt
        is_first = self.done_before < 0
        if is_first:
            self.done_before = max(done - 1, 0)
            if not done:  # told when the work begins
                self.started = time.perf_counter()
            self.first = done, time.perf_counter()
        if not sys.stderr.isatty():
            now = time.perf_counter()
            if is_first or done >= total or now - self.told >= _SELDOM:
                self.told = now
                words = [f"{self.what} {done}/{total}", sample_id, self._speed(done, total, now)]
                print(" ".join(word for word in words if word), file=sys.stderr)
            return
        if self.bar is None:
            from tqdm import tqdm

            self.bar = tqdm(
                total=total,
                initial=self.done_before,
                desc=printable(self.what),
                unit=self.unit,
                file=terminal(sys.stderr),
            )
        self.bar.set_postfix_str(printable(sample_id))
        self.bar.update(done - self.bar.n)

    def note(self, text: str) -> None:
        """Tell something that is no error."""
        line = f"{self.what}: {text}"
        if self.bar is None:
            print(line, file=sys.stderr)
        else:
            self.bar.write(printable(line), file=terminal(sys.stderr))

    def _speed(self, done: int, total: int, now: float) -> str:
        """Return the seconds so far, the rate, and the time left.

        What is left is told by what came after the first sample, which waits for workers to start.
        """
        seconds, since_first = now - self.started, done - self.first[0]
        if done == self.done_before:
            return ""
        if done >= total:
            return f"{seconds:.1f} s, {(done - self.done_before) / max(seconds, 1e-9):.3g}/s"
        if not since_first:
            return f"{seconds:.1f} s"
        rate = since_first / max(now - self.first[1], 1e-9)
        return f"{seconds:.1f} s, {rate:.3g}/s, {_in_words((total - done) / rate)} left"


def _in_words(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
