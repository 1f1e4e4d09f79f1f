"""The kernels that the headers of ``core/pc/gpu`` declare, and the arguments that each takes.

A kernel is declared once, in C++: ``PC_KERNEL(pc_name, const float* points, int64_t rows) {``. What is launched is held
to that: as many arguments, tensors of those types for pointers, whole numbers for int64_t, numbers for double.
"""

from __future__ import annotations

import functools
import hashlib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pcdata.files.opening import read_text

SOURCES = Path(__file__).parents[1] / "core"
KINDS = {"": "apart", "BLOCK_": "in blocks", "GRID_": "all together"}

_DEFINED = re.compile(r"^#define (\w+_PARAMETERS)\b((?:[^\n]*\\\n)*[^\n]*)", re.MULTILINE)
_KERNEL = re.compile(r"^PC_(|BLOCK_|GRID_)KERNEL\((\w+),\s*([^{]*?)\)\s*\{", re.MULTILINE)
_DTYPES = {
    "float*": (torch.float32,),
    "double*": (torch.float64,),
    "uint8_t*": (torch.uint8, torch.bool),
    "int32_t*": (torch.int32,),
    "uint32_t*": (torch.int32,),
    "int64_t*": (torch.int64,),
    "uint64_t*": (torch.int64,),
}
_NUMBERS: dict[str, type] = {"int64_t": int, "double": float}


class Parameter(NamedTuple):
    """One argument of a kernel."""

    name: str
    dtypes: tuple[torch.dtype, ...]  # that a tensor may have; none: a number
    number: type | None  # int or float; None: a tensor


class Kernel(NamedTuple):
    """A kernel as its header declares it."""

    name: str
    theme: str  # the header, without its ending: what is compiled together
    meets: str  # one of KINDS
    parameters: tuple[Parameter, ...]


@functools.cache
def kernels() -> dict[str, Kernel]:
    """Read all headers; return the kernels by name."""
    headers = sorted((SOURCES / "pc" / "gpu").glob("*.hpp"))
    texts = {header.stem: read_text("pcdata kernels", header) for header in headers}
    shared = "\n".join(texts.values())
    return {kernel.name: kernel for theme, text in texts.items() for kernel in declared(text, theme, shared)}


def declared(text: str, theme: str, shared: str = "") -> list[Kernel]:
    """Return the kernels of one header; ``shared`` defines parameters as well.

    Raises:
        ValueError: an argument is no pointer, int64_t or double.
    """
    text, shared = (re.sub(r"//[^\n]*", "", one) for one in (text, shared))
    definitions = {name: parameters.replace("\\", " ") for name, parameters in _DEFINED.findall(shared + text)}
    while used := next((name for name in definitions if re.search(rf"(?<!#define )\b{name}\b", text)), None):
        text = re.sub(rf"(?<!#define )\b{used}\b", definitions[used], text)
    return [
        Kernel(name, theme, KINDS[kind], tuple(_parameter(name, one) for one in listed.split(",")))
        for kind, name, listed in _KERNEL.findall(text)
    ]


def themes() -> list[str]:
    """Every header that declares kernels."""
    return sorted({kernel.theme for kernel in kernels().values()})


@functools.cache
def sources_digest() -> str:
    """Return what changes when any header that a kernel may read does."""
    digest = hashlib.sha256()
    for folder in ("gpu", "math"):
        for header in sorted((SOURCES / "pc" / folder).glob("*.hpp")):
            digest.update(f"{folder}/{header.name}\n".encode() + read_text("pcdata kernels", header).encode())
    return digest.hexdigest()


def values_of(kernel: Kernel, arguments: Sequence[Any], device_type: str) -> list[int | float]:
    """Return arguments as a kernel takes them, addresses for tensors and 0 for None, checked.

    Raises:
        TypeError: an argument is not what the header declares.
        ValueError: a tensor is not contiguous, or not on the device.
    """
    if len(arguments) != len(kernel.parameters):
        raise TypeError(
            f"{kernel.name} takes {len(kernel.parameters)} arguments, got {len(arguments)}; please report this"
        )
    values: list[int | float] = []
    for (name, dtypes, number), value in zip(kernel.parameters, arguments):
        if number is not None:
            if not isinstance(value, (int, float)) or (number is int and not isinstance(value, int)):
                raise TypeError(f"{kernel.name}: {name} takes {number.__name__}, got {value!r}; please report this")
            values.append(number(value))
        elif value is None:
            values.append(0)
        elif not isinstance(value, Tensor) or value.dtype not in dtypes:
            given = value.dtype if isinstance(value, Tensor) else type(value).__name__
            raise TypeError(f"{kernel.name}: {name} takes a tensor of {dtypes[0]}, got {given}; please report this")
        elif value.device.type != device_type or not value.is_contiguous():
            raise ValueError(
                f"{kernel.name}: {name} must be contiguous and on {device_type}, not of shape {tuple(value.shape)} "
                f"with strides {value.stride()} on {value.device}; please report this"
            )
        else:
            values.append(value.data_ptr())
    return values


def _parameter(kernel: str, text: str) -> Parameter:
    kind, _, name = re.sub(r"\s*\*\s*", "* ", text.replace("const ", "")).strip().rpartition(" ")
    if kind not in _DTYPES and kind not in _NUMBERS:
        raise ValueError(f"{kernel}: arguments are pointers, int64_t or double, not {text.strip()!r}")
    return Parameter(name, _DTYPES.get(kind, ()), _NUMBERS.get(kind))
