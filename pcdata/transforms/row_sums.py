"""A number per cloud that tells which rows were decided about."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, overload

import torch
from torch import Tensor

from pcdata.contracts.checksums import checksums
from pcdata.contracts.on_host import bounds_of
from pcdata.transforms.decisions import PER_ROW, TOLD_ROWS


def row_sums(params: Mapping[str, Tensor], ptr: Tensor) -> Sequence[int] | None:
    """Return a number per cloud between ``ptr`` for what params say of rows; None where they say nothing.

    What lies on another device is looked at when the numbers are read: the host does not wait for it in every step.
    """
    if TOLD_ROWS in params:
        told: list[int] = params[TOLD_ROWS].tolist()
        return told
    values = {name: value for name, value in params.items() if name in PER_ROW and name != "ptr"}
    if not values:
        return None
    kept = params.get("ptr")
    if ptr.device.type == "cpu":
        return _sums(values, kept, ptr)
    return _Later(len(ptr) - 1, lambda: _sums(values, kept, ptr))


def sums_when_read(index: Tensor, kept: Tensor, ptr: Tensor) -> Sequence[int]:
    """Return the same of rows (M,) int64 that nobody changes any more, cut by ``kept``: found out when it is read."""
    ends, begun = bounds_of(kept), bounds_of(ptr)
    return _Later(len(begun) - 1, lambda: checksums(index, ends, begun))


def _sums(values: Mapping[str, Tensor], kept: Tensor | None, ptr: Tensor) -> list[int]:
    bounds, sums = bounds_of(ptr), None
    for name, value in values.items():
        if name == "index" and value.dtype is not torch.bool:
            assert kept is not None  # of a step that picks rows by number
            own = checksums(value, bounds_of(kept), bounds)
        else:
            own = checksums(value, bounds)
        sums = own if sums is None else [31 * one + other for one, other in zip(sums, own)]
    assert sums is not None
    return sums


class _Later(Sequence[int]):
    """The numbers of B clouds, found out when somebody reads them."""

    def __init__(self, length: int, find: Callable[[], list[int]]) -> None:
        self._length = length
        self._find: Callable[[], list[int]] | None = find
        self._read: list[int] = []

    def _listed(self) -> list[int]:
        if self._find is not None:
            self._read, self._find = self._find(), None  # it holds what is looked at
        return self._read

    def __len__(self) -> int:
        return self._length

    @overload
    def __getitem__(self, which: int, /) -> int: ...
    @overload
    def __getitem__(self, which: slice, /) -> list[int]: ...
    def __getitem__(self, which: int | slice, /) -> int | list[int]:
        return self._listed()[which]

    def __reduce__(self) -> tuple[Any, ...]:
        return list, (self._listed(),)
