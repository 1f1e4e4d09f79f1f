"""The arguments of one call of an operation: bound to names, completed, and held to their specs."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.fields import Fields
from pcdata.contracts.numbers import Spec
from pcdata.contracts.on_host import uploaded
from pcdata.contracts.tensors import check_tensors, parse_spec
from pcdata.errors import DeviceError, DTypeError, ShapeError


@dataclass(frozen=True)
class Contract:
    """What a function's arguments must hold, with all that can be known before a call worked out."""

    name: str
    signature: inspect.Signature
    tensors: dict[str, str]  # argument -> contract string; row pointers last, when the number of rows is known
    others: dict[str, Spec]
    _names: frozenset[str]
    _positional: tuple[str, ...]
    _defaults: dict[str, Any]
    _required: tuple[str, ...]  # tensors that may not be None
    _pointers: tuple[tuple[str, str], ...]  # row pointers, the tensor whose rows they cut
    _optional: frozenset[str]  # other arguments whose default is None
    _fields: dict[str, Fields]  # arguments that hold tensors

    @classmethod
    def of(cls, function: Callable[..., Any], specs: Mapping[str, str | Spec]) -> Contract:
        """Work out the contract of a function whose arguments have these specs."""
        signature = inspect.signature(function)
        texts = {key: spec for key, spec in specs.items() if isinstance(spec, str)}
        parsed = {key: parse_spec(text) for key, text in texts.items()}
        rows = {spec.dims[0]: key for key, spec in reversed(parsed.items()) if not spec.is_ptr}
        defaults = {name: parameter.default for name, parameter in signature.parameters.items()}
        none = inspect.Parameter.empty
        return cls(
            name=function.__name__,
            signature=signature,
            tensors=dict(sorted(texts.items(), key=lambda item: parsed[item[0]].is_ptr)),
            others={key: spec for key, spec in specs.items() if not isinstance(spec, str)},
            _names=frozenset(defaults),
            _positional=tuple(
                name
                for name, parameter in signature.parameters.items()
                if parameter.kind is inspect.Parameter.POSITIONAL_OR_KEYWORD
            ),
            _defaults={name: default for name, default in defaults.items() if default is not none},
            _required=tuple(key for key, spec in parsed.items() if not spec.is_ptr and defaults[key] is none),
            _pointers=tuple((key, rows[spec.dims[0]]) for key, spec in parsed.items() if spec.is_ptr),
            _optional=frozenset(name for name, default in defaults.items() if default is None),
            _fields={key: spec for key, spec in specs.items() if isinstance(spec, Fields) and spec.tensors},
        )

    @property
    def tensors_alone(self) -> bool:
        """Whether no argument is an object that holds tensors."""
        return not self._fields

    def bind(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> dict[str, Any]:
        """Return all arguments by name; as ``inspect.Signature.bind``, at a fraction of the price.

        Raises:
            TypeError: they do not fit the signature.
        """
        given = dict(zip(self._positional, args))
        arguments = {**self._defaults, **given, **kwargs}
        if len(given) == len(args) and given.keys().isdisjoint(kwargs) and arguments.keys() == self._names:
            return arguments
        self.signature.bind(*args, **kwargs)
        raise AssertionError(f"{self.name}: the arguments fit after all")

    def check(self, arguments: dict[str, Any]) -> None:
        """Hold the arguments to their specs, in place; row pointers given as None become ``[0, N]``.

        Raises:
            DTypeError, ShapeError, DeviceError, NonFiniteError: a tensor breaks its contract.
            PcdataError: what a spec of another argument raises.
        """
        for key in self._required:
            if arguments[key] is None:
                raise DTypeError(f"{self.name}: {key} must be a torch.Tensor, not None")
        for pointers, key in self._pointers:
            rows = arguments[key]
            if arguments[pointers] is not None:
                if rows is None:
                    raise ShapeError(f"{self.name}: {pointers} was given without {key}; pass both or neither")
            elif isinstance(rows, Tensor) and rows.ndim:
                one = torch.tensor([0, rows.shape[0]], dtype=torch.int64, device="cpu")
                arguments[pointers] = uploaded(one, rows.device)
        check_tensors(self.name, arguments, self.tensors)
        for key, spec in self.others.items():
            if arguments[key] is not None or key not in self._optional:
                arguments[key] = spec(self.name, key, arguments)
        if self._fields:
            devices = {spec.device(arguments[key]) for key, spec in self._fields.items()}
            if len(devices) > 1:
                raise DeviceError(f"{self.name}: {' and '.join(self._fields)} are on different devices; move one")

    def device(self, arguments: Mapping[str, Any]) -> torch.device:
        """Return where the call is to be computed: on the device of its first tensor."""
        for key in self.tensors:
            if arguments[key] is not None:
                device: torch.device = arguments[key].device
                return device
        for key in self._fields:
            found = self._fields[key].device(arguments[key])
            if found is not None:
                return found
        return torch.device("cpu")
