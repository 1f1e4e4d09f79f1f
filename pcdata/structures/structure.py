"""What all frozen structures share: copies without checking again what is known to hold, and moves between devices."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import torch
from torch import Tensor

from pcdata.contracts.on_host import SMALL, hold
from pcdata.errors import DTypeError

S = TypeVar("S")
Movable = TypeVar("Movable", bound="Structure")


def derived(structure: S, **changes: Any) -> S:
    """Return a copy with other attributes; only for changes that keep everything the constructor checks."""
    copy = object.__new__(type(structure))
    copy.__dict__.update(structure.__dict__)
    copy.__dict__.update(changes)
    return copy


def made(kind: type[S], **attributes: Any) -> S:
    """Return a structure of all its attributes, which are known to be what the constructor requires and fills in."""
    structure = object.__new__(kind)
    structure.__dict__.update(attributes)
    return structure


def checked_copy(structure: S, **changes: Any) -> S:
    """Return a copy with other attributes, made by the constructor: ``dataclasses.replace`` that reads no attribute.

    So what is computed when it is read, a history, is handed on as it is held.
    """
    return type(structure)(**{**vars(structure), **changes})


class Structure:
    """A frozen dataclass of tensors, of mappings of them, and of structures; whatever else it holds stays as it is."""

    def to(self: Movable, device: torch.device | str | int, *, non_blocking: bool = False) -> Movable:
        """Move all tensors to a device; their dtypes stay.

        Raises:
            DTypeError: what is given is no device.
        """
        given: Any = device  # whatever the annotation promises: a tensor's own method would take a dtype, for masks too
        if not isinstance(given, (torch.device, str, int)) or isinstance(given, bool):
            raise DTypeError(
                f"{type(self).__name__}.to: takes a device, got {given!r:.100}; of another dtype is the tensor that a "
                "network is fed, batch.points.to(device, dtype)"
            )

        def move(tensor: Tensor) -> Tensor:
            moved = tensor.to(device, non_blocking=non_blocking)
            if tensor.device.type == "cpu" != moved.device.type and tensor.numel() <= SMALL:
                hold(moved, tensor.detach().clone())
            return moved

        return self._mapped(move)

    def cuda(self: Movable, device: torch.device | str | int | None = None, *, non_blocking: bool = False) -> Movable:
        """Move all tensors to a CUDA device; None = the current one."""
        number = torch.device("cuda", device) if isinstance(device, int) else torch.device(device or "cuda")
        return self.to(number, non_blocking=non_blocking)

    def cpu(self: Movable) -> Movable:
        """Move all tensors to host memory."""
        return self.to("cpu")

    def pin_memory(self: Movable) -> Movable:
        """Copy all tensors to page-locked memory; a DataLoader with ``pin_memory=True`` calls this."""
        return self._mapped(lambda tensor: tensor.pin_memory())

    def _mapped(self: Movable, move: Callable[[Tensor], Tensor]) -> Movable:
        mapped: Movable = with_tensors(self, move)
        return mapped


def with_tensors(value: Any, swap: Callable[[Any], Any]) -> Any:
    """Return a value of structures with every tensor in them swapped."""
    if isinstance(value, Tensor):
        return swap(value)
    if isinstance(value, Structure):
        return derived(value, **{name: with_tensors(one, swap) for name, one in vars(value).items()})
    if isinstance(value, Mapping) and any(isinstance(one, (Tensor, Structure)) for one in value.values()):
        return {name: with_tensors(one, swap) for name, one in value.items()}
    return value
