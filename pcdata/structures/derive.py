"""Copies of frozen structures without checking again what is known to hold."""

from __future__ import annotations

from typing import Any, TypeVar

Structure = TypeVar("Structure")


def derived(structure: Structure, **changes: Any) -> Structure:
    """Return a copy with other attributes; only for changes that keep everything the constructor checks."""
    copy = object.__new__(type(structure))
    copy.__dict__.update(structure.__dict__)
    copy.__dict__.update(changes)
    return copy
