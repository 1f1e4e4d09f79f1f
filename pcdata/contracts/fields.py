"""The spec of an argument that is a dataclass of tensors, or several of them: a view, the blocks of a volume."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.tensors import check_tensors
from pcdata.errors import DeviceError, DTypeError


class Fields:
    """An instance of a class whose tensors keep their contracts; their values are its maker's to check.

    Those of ``numbers``, small ones that the host reads, may lie on another device than the others.
    """

    def __init__(self, kind: type, *, numbers: Mapping[str, str] = MappingProxyType({}), **tensors: str) -> None:
        self.kind = kind
        self.numbers = numbers
        self.tensors = tensors

    def __call__(self, where: str, name: str, arguments: Mapping[str, Any]) -> Any:
        """Hold one argument to this spec; the fields must lie on the device of the tensors of the call."""
        value = arguments[name]
        if not isinstance(value, self.kind):
            raise DTypeError(f"{where}: {name} must be a {self.kind.__name__}, not {type(value).__name__}")
        for specs in (self.tensors, self.numbers):
            found = {key: getattr(value, key) for key in specs}
            check_tensors(f"{where}: {name}", found, specs, check_values=False)
        device = self.device(value)
        for other, beside in arguments.items():
            if device is not None and isinstance(beside, Tensor) and beside.device != device:
                raise DeviceError(f"{where}: {name} is on {device} but {other} is on {beside.device}; move one")
        return value

    def device(self, value: Any) -> torch.device | None:
        """Return where the fields lie; None where there is no tensor."""
        for key in self.tensors:
            tensor = getattr(value, key)
            if tensor is not None:
                device: torch.device = tensor.device
                return device
        return None


class Several(Fields):
    """A sequence of at least one such instance, all on one device."""

    def __init__(self, each: Fields) -> None:
        super().__init__(each.kind, numbers=each.numbers, **each.tensors)
        self.each = each

    def __call__(self, where: str, name: str, arguments: Mapping[str, Any]) -> Any:
        """Hold every instance to the spec."""
        values = arguments[name]
        if not isinstance(values, (list, tuple)) or not values:
            raise DTypeError(
                f"{where}: {name} must be a list of at least one {self.kind.__name__}, not {type(values).__name__} "
                f"{'' if values else 'without any'}".rstrip()
            )
        for number, value in enumerate(values):
            one = f"{name}[{number}]"
            self.each(where, one, {**arguments, one: value})
        devices = {str(self.each.device(value)) for value in values}
        if len(devices) > 1:
            raise DeviceError(f"{where}: {name} are on {' and '.join(sorted(devices))}; move them to one device")
        return values

    def device(self, value: Any) -> torch.device | None:
        """Return where they lie."""
        return self.each.device(value[0])
