"""Tensor contracts: shapes with named dimensions, dtypes, devices, row pointers, finiteness.

A contract is a short string read by :func:`check_tensors`:

* ``"N 3"``: a float32 tensor of that shape; equal letters must agree across the call.
* ``"V H W : uint8"``: the same with a dtype; ``float`` means float32 or float64.
* ``"V H W : depth"``: float32 lengths, none below 0; ``image``: uint8, float32 or float64.
* ``"ptr N B"``: int64 row pointers of shape (B+1,) that cut N rows into B clouds.
* ``"ptr N B >= 3"``: the same, with at least 3 rows in every cloud.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import torch
from torch import Tensor

from pcdata.contracts.host import all_finite, any_negative
from pcdata.contracts.known import FINITE, NOT_NEGATIVE, is_known, note
from pcdata.contracts.on_host import bounds_of, held, hold, read_together
from pcdata.errors import CaptureError, DeviceError, DTypeError, NonFiniteError, ShapeError, TooFewPointsError

_DTYPES: dict[str, tuple[torch.dtype, ...]] = {
    "float32": (torch.float32,),
    "float64": (torch.float64,),
    "float": (torch.float32, torch.float64),
    "depth": (torch.float32,),
    "int64": (torch.int64,),
    "uint8": (torch.uint8,),
    "int32": (torch.int32,),
    "bool": (torch.bool,),
    "image": (torch.uint8, torch.float32, torch.float64),
}


@dataclass(frozen=True)
class _TensorSpec:
    """One parsed contract."""

    dims: tuple[str, ...]
    bindings: tuple[tuple[str, int | None], ...]  # dims to be bound, with the size of those that are numbers
    dtypes: tuple[torch.dtype, ...]
    is_ptr: bool = False
    is_depth: bool = False  # no value is negative
    least: int = 0  # rows of every cloud that row pointers cut

    def describe(self) -> str:
        """Say the contract in words for an error message."""
        if self.is_ptr:
            return f"int64 row pointers ({self.dims[1]}+1,) over {self.dims[0]} rows"
        names = " or ".join(str(dtype).removeprefix("torch.") for dtype in self.dtypes)
        return f"{names} ({', '.join(self.dims)}{',' if len(self.dims) == 1 else ''})"


@cache
def parse_spec(text: str) -> _TensorSpec:
    """Parse a contract string; see the module docstring for the grammar."""
    if text.startswith("ptr "):
        pointers, _, least = text.partition(">=")
        _, rows, clouds = pointers.split()
        return _TensorSpec((rows, clouds), ((clouds, None),), (torch.int64,), is_ptr=True, least=int(least or 0))
    shape, _, dtype = (part.strip() for part in text.partition(":"))
    dims = tuple(shape.split())
    bindings = tuple([(dim, int(dim) if dim.isdigit() else None) for dim in dims])
    return _TensorSpec(dims, bindings, _DTYPES[dtype or "float32"], is_depth=dtype == "depth")


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
        check_values: also read values (row pointers, finiteness); on CUDA the host waits once for all of those that
            are not known, see :mod:`pcdata.contracts.known`.

    Returns:
        The size bound to every named dimension.

    Raises:
        DTypeError, ShapeError, DeviceError, NonFiniteError: the first contract that does not hold.
    """
    sizes: dict[str, int] = {}
    bound_by: dict[str, str] = {}
    first = ""
    device: torch.device | None = None  # of the first
    there: list[tuple[str, Tensor, _TensorSpec]] = []  # whose values are to be read
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
        _bind_shape(where, name, value.shape, spec, sizes, bound_by)
        if device is None:
            first, device = name, value.device
        elif value.device != device:
            raise DeviceError(f"{where}: {name} is on {value.device} but {first} is on {device}; move one with .to()")
        there.append((name, value, spec))
    if not check_values:
        return sizes
    if device is not None and device.type != "cpu":
        _read_values(there, finite=finite)
    for name, value, spec in there:
        if spec.is_ptr:
            check_ptr_values(where, name, value, sizes.get(spec.dims[0]))
            if spec.least:
                _require_rows(where, value, spec, bound_by.get(spec.dims[0], name))
        elif finite and value.dtype.is_floating_point and not _known_finite(value):
            bad = int((~torch.isfinite(value)).sum())
            raise NonFiniteError(
                f"{where}: {name} has {bad} NaN or infinite values of {value.numel()}; "
                "drop those points (or set those depths to 0) first"
            )
        elif spec.is_depth:
            check_depths(where, name, value)
    return sizes


def _read_values(values: Sequence[tuple[str, Tensor, _TensorSpec]], *, finite: bool) -> None:
    """Read what is not known of values on another device, all at once."""
    pointers, asked = [], []
    for _, value, spec in values:
        if held(value) is not None:
            continue
        if spec.is_ptr:
            pointers.append(value)
            continue
        if finite and value.dtype.is_floating_point and not is_known(FINITE, value):
            asked.append((FINITE, value, torch.isfinite(value).all()))
        if spec.is_depth and not is_known(NOT_NEGATIVE, value):
            asked.append((NOT_NEGATIVE, value, ~(value < 0).any()))
    answers = read_together([*pointers, *(answer for _, _, answer in asked)])
    for ptr, bounds in zip(pointers, answers):
        hold(ptr, torch.tensor(bounds, dtype=torch.int64, device="cpu"))
    for (fact, value, _), (answer,) in zip(asked, answers[len(pointers) :]):
        if answer:
            note(fact, value)


def _known_finite(value: Tensor) -> bool:
    """Say whether all values are finite; within a chain each tensor is read once."""
    if is_known(FINITE, value):
        return True
    if not all_finite(value):
        return False
    note(FINITE, value)
    return True


def check_ptr_values(where: str, name: str, ptr: Tensor, num_rows: int | None) -> None:
    """Require row pointers that start at 0, never decrease, and end at ``num_rows`` (None: any end)."""
    bounds = bounds_of(ptr)
    if bounds[0] != 0 or bounds != sorted(bounds):
        raise ShapeError(f"{where}: {name} must start at 0 and never decrease, got {_short(bounds)}")
    if num_rows is not None and bounds[-1] != num_rows:
        raise ShapeError(f"{where}: {name} must end at the number of rows, {num_rows}, but ends at {bounds[-1]}")


def check_depths(where: str, name: str, depths: Tensor) -> None:
    """Require a depth or range image without negative values.

    Raises:
        CaptureError: with how many are negative, and the lowest.
    """
    if is_known(NOT_NEGATIVE, depths):
        return
    if any_negative(depths):
        negative = depths < 0
        raise CaptureError(
            f"{where}: {name} must be metres with 0 for no reading, but {int(negative.sum())} values are negative "
            f"(lowest {float(depths.detach().min()):g}); set them to 0 where the image is read"
        )
    note(NOT_NEGATIVE, depths)


def _require_rows(where: str, ptr: Tensor, spec: _TensorSpec, rows: str) -> None:
    bounds = bounds_of(ptr)
    counts = [stop - start for start, stop in pairwise(bounds)]
    if min(counts) < spec.least:
        short = [cloud for cloud, count in enumerate(counts) if count < spec.least]
        found = f"has {counts[short[0]]} of the {spec.least} points it needs" if counts[short[0]] else "is empty"
        raise TooFewPointsError(
            f"{where}: cloud {short[0]} of {rows} {found}; leave such clouds out ({len(short)} of {len(counts)})"
        )


def _bind_shape(
    where: str, name: str, given: torch.Size, spec: _TensorSpec, sizes: dict[str, int], bound_by: dict[str, str]
) -> None:
    wanted: Sequence[tuple[str, int | None]] = spec.bindings
    found: Sequence[int] = given
    if spec.is_ptr:
        if len(given) != 1 or given[0] < 2:
            raise ShapeError(
                f"{where}: {name} must be {spec.describe()}, got shape {tuple(given)}; one cloud is [0, N]"
            )
        found = (given[0] - 1,)
    fits = len(found) == len(wanted)
    for (_, want), size in zip(wanted, found):
        fits = fits and (want is None or want == size)
    if not fits:
        raise ShapeError(f"{where}: {name} must be {spec.describe()}, got shape {tuple(given)}")
    for (dim, want), size in zip(wanted, found):
        if want is None:
            if dim not in sizes:
                sizes[dim], bound_by[dim] = size, name
            elif sizes[dim] != size:
                raise ShapeError(
                    f"{where}: {name} has {dim}={size} but {bound_by[dim]} has {dim}={sizes[dim]}; they must agree"
                )


def _short(values: list[int]) -> str:
    return str(values) if len(values) <= 8 else f"[{', '.join(map(str, values[:6]))}, ..., {values[-1]}]"
