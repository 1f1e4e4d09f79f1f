"""Errors of DataLoader workers that keep their step, sample id and path on the way to the parent.

torch sends the *class* of an error and its text from a worker, and makes a new error of these in the parent: attributes
of the instance are lost. So the worker raises an error of a class of its own, which has them, and which is pickled as
the class it stands for and what it has.
"""

from __future__ import annotations

import copyreg
from typing import Any

_PLACE = ("step", "sample_id", "path")


class _Located(type):
    """The class of such classes: pickle looks up how to send them under it."""


def for_the_parent(error: Exception) -> Exception:
    """Return the error as one that a worker may raise: an instance of its type, with the same words and attributes."""
    place = {name: getattr(error, name, None) for name in _PLACE}
    try:
        sent: Exception = _located(type(error), place)(*error.args)
    except Exception:  # it takes other arguments than it keeps, or no subclass: torch cannot send such an error either
        return error
    sent.__dict__.update(vars(error))
    return sent.with_traceback(error.__traceback__)


def _located(kind: type[Exception], place: dict[str, Any]) -> Any:
    names: dict[str, Any] = {"__module__": kind.__module__, "__qualname__": kind.__qualname__, "__doc__": kind.__doc__}
    if issubclass(kind, KeyError):  # which shows its text with escapes, unless torch knows the class by itself
        names["__str__"] = Exception.__str__
    return _Located(kind.__name__, (kind,), {**names, **place})


def _as_pickled(kind: type) -> tuple[Any, ...]:
    return _located, (kind.__bases__[0], {name: vars(kind)[name] for name in _PLACE})


copyreg.pickle(_Located, _as_pickled)
