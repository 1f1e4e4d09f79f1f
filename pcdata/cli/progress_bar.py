"""Progress of a long command."""

from __future__ import annotations

import sys
import time
from typing import Any

from pcdata.cli import signals
from pcdata.cli.printable import printable, terminal


class ProgressBar:
    """A bar on a terminal, plain lines elsewhere; also the place where a lost Ctrl-C is heard."""

    def __init__(self, what: str, *, unit: str = "sample") -> None:
        self.what = what
        self.unit = unit
        self.bar: Any = None
        self.started = time.perf_counter()

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.close()

    def __call__(self, done: int, total: int, sample_id: str) -> None:
        """Show that ``done`` of ``total`` samples are finished."""
        if signals.current.first is not None:  # raised inside a destructor or a callback, where Python drops exceptions
            raise KeyboardInterrupt
        if not sys.stderr.isatty():
            print(f"{self.what} {done}/{total} {sample_id} {time.perf_counter() - self.started:.1f} s", file=sys.stderr)
            return
        if self.bar is None:
            from tqdm import tqdm

            self.bar = tqdm(total=total, desc=printable(self.what), unit=self.unit, file=terminal(sys.stderr))
        self.bar.set_postfix_str(printable(sample_id))
        self.bar.update(done - self.bar.n)
