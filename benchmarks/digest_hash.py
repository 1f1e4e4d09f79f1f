"""A SHA-256 over all numbers of a result: dtypes, shapes and bytes; no class names, no words."""

from __future__ import annotations

import dataclasses
import enum
import hashlib
import struct
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from digest_names import NOUNS, as_recorded

NUMBERS, FACTS = "numbers", "facts"


class Many(dict):
    """Results of one case that get digests of their own, by what is added to the case's name."""


def leaves(value: Any, want: str = NUMBERS, path: str = "") -> Iterator[tuple[str, bytes]]:
    """Yield every number and name in a result with its place; of ``FACTS``, only histories and where it came from."""
    noun = next((NOUNS[cls] for cls in type(value).__mro__ if cls in NOUNS), None)
    if noun is not None:
        for name in noun[0]:
            yield from leaves(getattr(value, name), want, f"{path}.{name}")
        for name in noun[1] if want == FACTS else ():
            yield from leaves(as_recorded(getattr(value, name)), NUMBERS, f"{path}.{name}")
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            if not field.name.startswith("_"):
                yield from leaves(getattr(value, field.name), want, f"{path}.{field.name}")
    elif isinstance(value, Mapping):
        for key in sorted(value, key=str):
            yield from leaves(value[key], want, f"{path}[{plain_key(key)}]")
    elif isinstance(value, (list, tuple)):
        if want == NUMBERS:
            yield f"{path}#", str(len(value)).encode()
        for place, entry in enumerate(value):
            yield from leaves(entry, want, f"{path}[{place}]")
    elif want == NUMBERS:
        yield path, content(value)


def plain_key(key: Any) -> str:
    return str(key.value if isinstance(key, enum.Enum) else key)


def content(value: Any) -> bytes:
    """The bytes of one number, array or name."""
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray):
        array = np.ascontiguousarray(value)
        order = array.astype(array.dtype.newbyteorder("<"), copy=False)
        return f"{order.dtype.str}{value.shape}".encode() + order.tobytes()
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, enum.Enum):
        value = value.value
    if isinstance(value, float):
        return b"f" + (b"nan" if value != value else struct.pack("<d", value))
    if isinstance(value, bytes):
        return b"b" + value
    if value is None or isinstance(value, (bool, int, str)):
        return f"{type(value).__name__}:{value}".encode()
    raise TypeError(f"digest: cannot hash a {type(value).__name__}: {value!r:.80}")


def digest(value: Any, want: str = NUMBERS) -> str | None:
    """Return the SHA-256 of the numbers, or of the facts; None where there is nothing of the kind."""
    total, some = hashlib.sha256(), False
    for path, text in leaves(value, want):
        total.update(f"{path}\0{len(text)}\0".encode() + text)
        some = True
    return total.hexdigest() if some else None


def digests_of(name: str, value: Any, *, by_leaf: bool = False) -> Iterator[tuple[str, str]]:
    """Yield the digests of one case: of its numbers, and of its facts where it has some; or of every leaf alone."""
    if isinstance(value, Many):
        for key in value:
            yield from digests_of(f"{name}/{key}", value[key], by_leaf=by_leaf)
        return
    for want, suffix in ((NUMBERS, ""), (FACTS, " facts")):
        if by_leaf:
            for path, text in leaves(value, want):
                yield f"{name}{suffix} {path}", hashlib.sha256(text).hexdigest()
        elif (found := digest(value, want)) is not None:
            yield name + suffix, found
