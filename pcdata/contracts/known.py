"""What is known of tensors while a chain runs: what one step has found or made is not looked at again by the next.

A chain's data pass from step to step, and nobody else holds them. So values that were read once (all finite, pixels
that rise) are not read again, and rows picked from such values are known to be like them. Nothing is known before a
chain begins, nothing is when it has ended, and a change in place by torch makes a tensor unknown.
"""

from __future__ import annotations

import weakref
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from torch import Tensor

FINITE = "finite"  # no value is NaN or infinite
NOT_NEGATIVE = "not negative"  # no value is below 0
RIGID = "rigid"  # motions that an image grid may have

_Held = tuple[tuple["weakref.ref[Tensor]", int], ...]

_facts: ContextVar[dict[tuple[Hashable, ...], _Held] | None] = ContextVar("known_facts", default=None)


@contextmanager
def keeping_known() -> Iterator[None]:
    """Keep what is found about tensors until the end; what was known before is not known within."""
    token = _facts.set({})
    try:
        yield
    finally:
        _facts.reset(token)


@contextmanager
def knowing_nothing() -> Iterator[None]:
    """Forget all, and learn nothing until the end: somebody else has the data in hand."""
    forget()
    token = _facts.set(None)
    try:
        yield
    finally:
        _facts.reset(token)


def forget() -> None:
    """Forget all: memory was written to."""
    facts = _facts.get()
    if facts:
        facts.clear()


def is_known(fact: Hashable, *tensors: Tensor) -> bool:
    """Say whether a fact about tensors, together, was found or concluded within this run of a chain."""
    facts = _facts.get()
    if not facts:
        return False
    held = facts.get((fact, *map(id, tensors)))
    if held is None:
        return False
    for (reference, version), tensor in zip(held, tensors):
        if reference() is not tensor or tensor._version != version:
            return False
    return True


def note(fact: Hashable, *tensors: Tensor) -> None:
    """Keep a fact about tensors that was found, or follows from how they were made."""
    facts = _facts.get()
    if facts is None:
        return
    for tensor in tensors:
        if tensor.is_inference():  # nobody counts changes of it
            return
    facts[(fact, *map(id, tensors))] = tuple([(weakref.ref(tensor), tensor._version) for tensor in tensors])
