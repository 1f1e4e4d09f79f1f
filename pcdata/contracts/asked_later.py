"""Questions to another device that may be put off until somebody reads its answers anyway."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import NamedTuple

from torch import Tensor


class PutOff(NamedTuple):
    """What work that is to be repeated leaves behind."""

    flags: list[Tensor]  # that :func:`is_set` was asked about, (1,) each
    constants: list[Tensor]  # that it reads again every time


_put_off: ContextVar[PutOff | None] = ContextVar("questions_put_off", default=None)


@contextmanager
def asking_later() -> Iterator[PutOff]:
    """Put off what :func:`is_set` asks."""
    put_off = PutOff([], [])
    token = _put_off.set(put_off)
    try:
        yield put_off
    finally:
        _put_off.reset(token)


def is_set(flag: Tensor) -> bool:
    """Say whether a number (1,) is not 0; within :func:`asking_later` it is noted, and taken for 0."""
    put_off = _put_off.get()
    if put_off is None:
        return bool(int(flag))
    put_off.flags.append(flag)
    return False


def constant(values: Tensor) -> Tensor:
    """Return values that lie in some cache; within :func:`asking_later` they are kept as long as work is repeated."""
    put_off = _put_off.get()
    if put_off is not None:
        put_off.constants.append(values)
    return values
