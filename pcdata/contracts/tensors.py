"""Tensor contracts: shapes with named dimensions, dtypes, devices, row pointers, finiteness.

A contract is a short string read by :func:`check_tensors`:

* ``"N 3"``: a float32 tensor of that shape; equal letters must agree across the call.
* ``"V H W : uint8"``: the same with a dtype; ``float`` means float32 or float64.
* ``"ptr N B"``: int64 row pointers of shape (B+1,) that cut N rows into B clouds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import torch
from torch import Tensor

from pcdata.contracts.host import all_finite
from pcdata.errors import DeviceError, DTypeError, NonFiniteError, ShapeError

_DTYPES: dict[str, tuple[torch.dtype, ...]] = {
    "float32": (torch.float32,),
    "float64": (torch.float64,),
    "float": (torch.float32, torch.float64),
    "int64": (torch.int64,),
    "uint8": (torch.uint8,),
    "bool": (torch.bool,),
}


@dataclass(frozen=True)
class TensorSpec:
    """One parsed contract."""

    dims: tuple[str, ...]
    dtypes: tuple[torch.dtype, ...]
    is_ptr: bool = False

    def describe(self) -> str:
        """Say the contract in words for an error message."""
        if self.is_ptr:
            return f"int64 row pointers ({self.dims[1]}+1,) over {self.dims[0]} rows"
        names = " or ".join(str(dtype).removeprefix("torch.") for dtype in self.dtypes)
        return f"{names} ({', '.join(self.dims)}{',' if len(self.dims) == 1 else ''})"


@cache
def parse_spec(text: str) -> TensorSpec:
    """Parse a contract string; see the module docstring for the grammar."""
    if text.startswith("ptr "):
        _, rows, clouds = text.split()
        return TensorSpec((rows, clouds), (torch.int64,), is_ptr=True)
    shape, _, dtype = text.partition(":")
    return TensorSpec(tuple(shape.split()), _DTYPES[dtype.strip() or "float32"])


def check_tensors(
    where: str,
    values: Mapping[str, Tensor | None],
    specs: Mapping[str, str],
    *,
    finite: bool = True,
    check_values: bool = True,
) -> dict[str, int]:
    """Hold every tensor to its contract and all of them to one device; None is skipped.

    Args:
        where: the function or class named in the error.
        values: argument name to tensor.
        specs: argument name to contract string.
        finite: also require float values to be finite.
        check_values: also read values (row pointers, finiteness); on CUDA this waits for the device.

    Returns:
        The size bound to every named dimension.

    Raises:
        DTypeError, ShapeError, DeviceError, NonFiniteError: the first contract that does not hold.
    """
    sizes: dict[str, int] = {}
    bound_by: dict[str, str] = {}
    device: tuple[str, torch.device] | None = None
    for name, text in specs.items():
        value = values.get(name)
        if value is None:
            continue
        spec = parse_spec(text)
        if not isinstance(value, Tensor):
            raise DTypeError(f"{where}: {name} must be a torch.Tensor, {spec.describe()}, not {type(value).__name__}")
        if value.dtype not in spec.dtypes:
            raise DTypeError(
                f"{where}: {name} must be {spec.describe()}, not {value.dtype}; convert it before the call"
            )
        _bind_shape(where, name, value, spec, sizes, bound_by)
        if device is None:
            device = (name, value.device)
        elif value.device != device[1]:
            raise DeviceError(
                f"{where}: {name} is on {value.device} but {device[0]} is on {device[1]}; move one with .to()"
            )
        if not check_values:
            continue
        if spec.is_ptr:
            check_ptr_values(where, name, value, sizes.get(spec.dims[0]))
        elif finite and value.dtype.is_floating_point and not all_finite(value):
            bad = int((~torch.isfinite(value)).sum())
            raise NonFiniteError(
                f"{where}: {name} has {bad} NaN or infinite values of {value.numel()}; "
                "drop those points (or set those depths to 0) first"
            )
    return sizes


def check_ptr_values(where: str, name: str, ptr: Tensor, num_rows: int | None) -> None:
    """Require row pointers that start at 0, never decrease, and end at ``num_rows`` (None: any end)."""
    bounds = ptr.tolist()
    if bounds[0] != 0 or any(later < earlier for earlier, later in pairwise(bounds)):
        raise ShapeError(f"{where}: {name} must start at 0 and never decrease, got {_short(bounds)}")
    if num_rows is not None and bounds[-1] != num_rows:
        raise ShapeError(f"{where}: {name} must end at the number of rows, {num_rows}, but ends at {bounds[-1]}")


def _bind_shape(
    where: str, name: str, value: Tensor, spec: TensorSpec, sizes: dict[str, int], bound_by: dict[str, str]
) -> None:
    given = tuple(value.shape)
    if spec.is_ptr:
        if value.ndim != 1 or value.numel() < 2:
            raise ShapeError(f"{where}: {name} must be {spec.describe()}, got shape {given}; one cloud is [0, N]")
        actual = {spec.dims[1]: value.numel() - 1}
    else:
        if value.ndim != len(spec.dims):
            raise ShapeError(f"{where}: {name} must be {spec.describe()}, got shape {given}")
        actual = dict(zip(spec.dims, given))
        for dim, size in zip(spec.dims, given):
            if dim.isdigit() and int(dim) != size:
                raise ShapeError(f"{where}: {name} must be {spec.describe()}, got shape {given}")
    for dim, size in actual.items():
        if dim.isdigit():
            continue
        if sizes.setdefault(dim, size) != size:
            raise ShapeError(
                f"{where}: {name} has {dim}={size} but {bound_by[dim]} has {dim}={sizes[dim]}; they must agree"
            )
        bound_by.setdefault(dim, name)


def _short(values: list[int]) -> str:
    return str(values) if len(values) <= 8 else f"[{', '.join(map(str, values[:6]))}, ..., {values[-1]}]"
