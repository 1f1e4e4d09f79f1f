"""The declared fields of a transform's class, and whether given values fit them."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, get_args, get_type_hints

import numpy as np
from torch import Tensor

from pcdata.errors import ConfigError, near_matches
from pcdata.transforms.fields import LengthIn


@functools.cache
def field_names(cls: type) -> tuple[str, ...]:
    """Return the names of the declared fields, in order."""
    return tuple(f.name for f in dataclasses.fields(cls))


@functools.cache
def field_types(cls: type) -> dict[str, Any]:
    """Return the declared fields' types with their limits."""
    hints = get_type_hints(cls, include_extras=True)
    return {name: hints[name] for name in field_names(cls)}


@functools.cache
def length_fields(cls: type) -> dict[str, str]:
    """Return the unit of every declared field that is a length in a unit."""
    found = {name: _length_unit(hint) for name, hint in field_types(cls).items()}
    return {name: unit for name, unit in found.items() if unit is not None}


def _length_unit(hint: Any) -> str | None:
    own = [note.unit for note in getattr(hint, "__metadata__", ()) if isinstance(note, LengthIn)]
    return next(iter(own), None) or next(filter(None, map(_length_unit, get_args(hint))), None)


@functools.cache
def _field_model(cls: type) -> Any:
    import pydantic  # imported late: only needed once a transform is made

    # Strict: a quoted number or a YAML yes/no is a slip of the pen, not a length or a count.
    config = pydantic.ConfigDict(arbitrary_types_allowed=True, extra="forbid", allow_inf_nan=False, strict=True)
    fields: Any = {}
    for field in dataclasses.fields(cls):
        if field.default is not dataclasses.MISSING:
            default = field.default
        elif field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        else:
            default = ...
        fields[field.name] = (field_types(cls)[field.name], default)
    return pydantic.create_model(cls.__name__, __config__=config, **fields)


def field_faults(cls: type, fields: Mapping[str, Any]) -> list[tuple[tuple[int | str, ...], str]]:
    """Return every fault of these fields as (path, message); empty when they are valid."""
    import pydantic

    try:
        _field_model(cls)(**_as_plain_fields(fields))
    except pydantic.ValidationError as error:
        return [(fault["loc"], _fault_message(cls, fault)) for fault in error.errors()]
    return []


def validated_fields(cls: type, fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields converted to their declared types.

    Raises:
        ConfigError: listing every fault.
    """
    given = _as_plain_fields(fields)
    faults = field_faults(cls, given)
    if faults:
        raise ConfigError("\n".join(f"{'.'.join(map(str, (cls.__name__, *path)))}: {text}" for path, text in faults))
    model = _field_model(cls)(**given)
    return {name: getattr(model, name) for name in field_names(cls)}


def _fault_message(cls: type, fault: Any) -> str:
    if fault["type"] == "extra_forbidden":
        name = str(fault["loc"][0])
        known = field_names(cls)
        return f"no such field{near_matches(name, known) or f'; {cls.__name__} has {list(known)}'}"
    given = "" if fault["type"] == "missing" else f" (got {fault['input']!r})"
    return f"{fault['msg']}{given}"


def _as_plain_fields(fields: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _as_plain(value) for name, value in fields.items()}


def _as_plain(value: Any) -> Any:
    """Turn arrays into numbers and lists into tuples, so that fields cannot change under a transform."""
    if isinstance(value, (Tensor, np.ndarray, np.generic)):
        value = value.tolist()
    return tuple(_as_plain(item) for item in value) if isinstance(value, (list, tuple)) else value
