"""Warnings of pcdata on the command line: one line each, once each, and never more than a few of a kind."""

from __future__ import annotations

import sys
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pcdata.errors import PcdataWarning

_SHOWN = 5  # texts of one kind; the rest is counted


@contextmanager
def warnings_in_one_line() -> Iterator[None]:
    """Show pcdata's warnings without the place in Python that gave them; other libraries' stay as they are."""
    shown: set[str] = set()
    kinds: Counter[str] = Counter()
    before = warnings.showwarning

    def show(message: Any, category: type[Warning], *place: Any, **more: Any) -> None:
        if not issubclass(category, PcdataWarning):
            before(message, category, *place, **more)
            return
        text = " ".join(str(message).split())
        if text in shown:
            return
        shown.add(text)
        kinds[category.__name__] += 1
        if kinds[category.__name__] <= _SHOWN:
            print(f"pcdata: warning: {text}", file=sys.stderr)

    warnings.showwarning = show
    try:
        yield
    finally:
        if warnings.showwarning is show:  # somebody may have put another in its place meanwhile, on purpose
            warnings.showwarning = before
        for kind, count in kinds.items():
            if count > _SHOWN:
                print(f"pcdata: warning: {count - _SHOWN} more of the kind {kind}", file=sys.stderr)
