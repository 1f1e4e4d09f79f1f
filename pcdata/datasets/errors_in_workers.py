"""Errors of DataLoader workers that keep their step, sample id and path on the way to the parent.

torch sends the *class* of an error and its text from a worker, and makes a new error of these in the parent: attributes
of the instance are lost. So the worker raises an error of a class of its own. What pickle sends in place of that class
makes an error of the usual class with those attributes, when torch calls it in the parent.
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
    return _Located(kind.__name__, (kind,), {**names, **place})


class _Maker:
    """Stands for the class in the parent: called with the text, it makes the error."""

    def __init__(self, kind: type[Exception], place: dict[str, Any]) -> None:
        self.__name__ = kind.__name__  # torch's text begins with it
        self._kind, self._place = kind, place

    def __call__(self, text: str) -> Exception:
        # KeyError shows its text as a literal, all in one line, unless that says itself how it looks.
        error = self._kind(_AsItIs(text) if issubclass(self._kind, KeyError) else text)
        error.__dict__.update(self._place)
        return error


class _AsItIs(str):
    """A text that looks like itself where Python would show a literal."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


def _as_pickled(kind: type) -> tuple[Any, ...]:
    return _Maker, (kind.__bases__[0], {name: vars(kind)[name] for name in _PLACE})


copyreg.pickle(_Located, _as_pickled)
