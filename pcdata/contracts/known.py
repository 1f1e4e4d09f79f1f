"""What is known of tensors, so that it is not looked at again.

While a chain runs, its data pass from step to step, and nobody else holds them. So values that were read once (all
finite, pixels that rise) are not read again, and rows picked from such values are known to be like them. Of host memory
nothing is known before a chain begins and nothing is when it has ended, as NumPy can change it unseen.

To look at values on another device the host waits until all work before it is done, and only torch changes them there.
So what is found there stays known, in a chain and out of it: values are checked the first time that a tensor comes to a
door. Anywhere a change in place by torch makes a tensor unknown.
"""

from __future__ import annotations

import weakref
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

FINITE = "finite"  # no value is NaN or infinite
NOT_NEGATIVE = "not negative"  # no value is below 0
RIGID = "rigid"  # motions that an image grid may have
METRES = "metres"  # half of the depths look like metres
UNSHARED = "unshared"  # a step of the chain has made it, and nobody outside the chain can change it
_OF_VALUES = (FINITE, NOT_NEGATIVE, METRES)

_Held = tuple[tuple["weakref.ref[Tensor]", int], ...]

_facts: ContextVar[dict[tuple[Hashable, ...], _Held] | None] = ContextVar("known_facts", default=None)
# Of the first tensor of a fact, on another device: its facts.
_elsewhere: WeakIdKeyDictionary = WeakIdKeyDictionary()


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
    _elsewhere.clear()
    facts = _facts.get()
    if facts:
        facts.clear()


def is_known(fact: Hashable, *tensors: Tensor) -> bool:
    """Say whether a fact about tensors, together, is known: on the host within this run of a chain."""
    facts = _facts.get() if tensors[0].is_cpu else _elsewhere.get(tensors[0])
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
    for tensor in tensors:
        if tensor.is_inference():  # nobody counts changes of it
            return
    if not tensors[0].is_cpu:
        facts = _elsewhere.setdefault(tensors[0], {})
    if facts is None:
        return
    facts[(fact, *map(id, tensors))] = tuple([(weakref.ref(tensor), tensor._version) for tensor in tensors])


def pass_on(source: Tensor, result: Tensor) -> None:
    """Note of values taken from a tensor what is known of each of its values."""
    for fact in _OF_VALUES:
        if is_known(fact, source):
            note(fact, result)
