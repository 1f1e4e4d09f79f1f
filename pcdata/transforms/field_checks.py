"""The declared fields of a transform's class, and whether given values fit them."""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar, get_args, get_type_hints

import annotated_types
import numpy as np
from torch import Tensor

from pcdata.errors import ConfigError, near_matches

_Function = TypeVar("_Function", bound=Callable[..., Any])


def cached(function: _Function) -> _Function:
    """functools.cache under the function's own type: to a type checker no class of modules can be hashed."""
    return functools.cache(function)  # type: ignore[return-value]


@cached
def field_names(cls: type) -> tuple[str, ...]:
    """Return the names of the declared fields, in order."""
    return tuple(f.name for f in dataclasses.fields(cls))


def has_fields(cls: type, given: Mapping[str, Any]) -> bool:
    """Whether all that must be given is given, and nothing that is no field."""
    return field_types(cls).keys() >= given.keys() >= required_fields(cls)


@cached
def required_fields(cls: type) -> frozenset[str]:
    """Return the names of the fields without a default."""
    missing = dataclasses.MISSING
    return frozenset(f.name for f in dataclasses.fields(cls) if f.default is missing and f.default_factory is missing)


@cached
def field_types(cls: type) -> dict[str, Any]:
    """Return the declared fields' types with their limits."""
    hints = get_type_hints(cls, include_extras=True)
    return {name: hints[name] for name in field_names(cls)}


@cached
def length_fields(cls: type) -> dict[str, str]:
    """Return the unit of every declared field that is a length in a unit."""
    found = {name: _length_unit(hint) for name, hint in field_types(cls).items()}
    return {name: unit for name, unit in found.items() if unit is not None}


def _length_unit(hint: Any) -> str | None:
    own = [note.unit for note in getattr(hint, "__metadata__", ()) if isinstance(note, annotated_types.Unit)]
    return next(iter(own), None) or next(filter(None, map(_length_unit, get_args(hint))), None)


@cached
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


Path = tuple[int | str, ...]
_LEAVES = {str, int, float, bool, type(None)}


def faulty_config(message: str, faults: Sequence[tuple[Path, str]]) -> ConfigError:
    """Return an error that knows the path to every fault."""
    error = ConfigError(message)
    error.faults = list(faults)
    return error


def validated_fields(cls: type, fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields converted to their declared types.

    Raises:
        ConfigError: every fault with its path.
    """
    import pydantic

    try:
        model = _field_model(cls)(**_as_plain(fields))
    except pydantic.ValidationError as error:
        told: dict[Path, list[str]] = {}
        found = [(_place(fault["loc"]), fault) for fault in error.errors()]
        entered = {path[0] for path, _ in found if len(path) > 1}  # by one alternative: what is wrong is in there
        for path, fault in found:
            if not (len(path) == 1 and path[0] in entered and fault["type"].endswith("_type")):
                told.setdefault(path, []).append(_fault_message(cls, fault))
        faults = [(path, ", or: ".join(texts)) for path, texts in told.items()]
        lines = [f"{'.'.join(map(str, (cls.__name__, *path)))}: {text}" for path, text in faults]
        raise faulty_config("\n".join(lines), faults) from None
    return dict(vars(model))


def _place(path: Path) -> Path:
    """Leave out the alternatives of a type, which pydantic names between field and index."""
    return path[:1] + tuple(part for part in path[1:] if isinstance(part, int) or not _ALTERNATIVE.fullmatch(part))


_ALTERNATIVE = re.compile(r"(constrained-)?(float|str|int)|(tuple|literal|dict)\[.*\]")


def _fault_message(cls: type, fault: Any) -> str:
    if fault["type"] == "extra_forbidden":
        name = str(fault["loc"][0])
        known = field_names(cls)
        return f"no such field{near_matches(name, known) or f'; {cls.__name__} has {list(known)}'}"
    given = "" if fault["type"] == "missing" else f" (got {fault['input']!r})"
    limits = fault.get("ctx", {})
    is_angle = any(limits.get(name) in (math.pi / 2, math.pi, 2 * math.pi) for name in ("le", "lt"))
    way = "; it is in radians, a degree is 0.01745 of them" if is_angle else ""
    return f"{fault['msg']}{given}{way}"


def _as_plain(value: Any) -> Any:
    """Turn arrays into numbers and lists into tuples, so that fields cannot change under a transform."""
    if isinstance(value, Mapping):
        plain = {}
        for name, field in value.items():
            plain[name] = field if type(field) in _LEAVES else _as_plain(field)
        return plain
    if isinstance(value, (Tensor, np.ndarray, np.generic)):
        value = value.tolist()
    if not isinstance(value, (list, tuple)):
        return value
    return tuple(value) if _LEAVES.issuperset(map(type, value)) else tuple(_as_plain(item) for item in value)
