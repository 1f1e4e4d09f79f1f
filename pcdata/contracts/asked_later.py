"""Questions to another device that may be put off until somebody reads its answers anyway."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from torch import Tensor

_put_off: ContextVar[list[Tensor] | None] = ContextVar("questions_put_off", default=None)


@contextmanager
def asking_later() -> Iterator[list[Tensor]]:
    """Put off what :func:`is_set` asks; the flags come into the list that this gives."""
    flags: list[Tensor] = []
    token = _put_off.set(flags)
    try:
        yield flags
    finally:
        _put_off.reset(token)


def is_set(flag: Tensor) -> bool:
    """Say whether a number (1,) is not 0; within :func:`asking_later` it is noted, and taken for 0."""
    flags = _put_off.get()
    if flags is None:
        return bool(int(flag))
    flags.append(flag)
    return False
