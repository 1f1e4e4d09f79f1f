"""One public function per operation; several bodies may compute it.

``@op`` marks the public function: its own body is the reference, plain torch on any device. ``@kernel`` registers a
faster body beside it under a backend name; it receives arguments that already passed the contract, and must give the
same result. ``backend="auto"`` takes the fastest live backend for the device, and the reference where a gradient is
wanted; naming an absent backend raises with the reason.

``@inner`` marks what only pcdata itself calls, with tensors that it has checked already (picking rows, moving points):
kernels register beside it in the same way, but there is no contract to check and no ``backend`` to choose.
"""

from __future__ import annotations

import functools
import importlib
import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

from pcdata.checks import check_tensors, parse_spec
from pcdata.errors import BackendError, DTypeError, near_matches

P = ParamSpec("P")
R = TypeVar("R")

REFERENCE = "torch"

# Backend name -> module that registers its kernels when imported and defines `unavailable() -> str | None`.
BACKEND_MODULES = {"cpu": "pcdata.kernels.cpu", "torch_cluster": "pcdata.kernels.torch_cluster"}

# What `auto` tries, best first. torch_cluster is chosen only by name: it covers few calls.
AUTO_ORDER: dict[str, tuple[str, ...]] = {"cpu": ("cpu", REFERENCE), "cuda": (REFERENCE,)}


@dataclass
class Operation:
    """A registered operation: its contract, its reference and its kernels."""

    name: str
    specs: dict[str, str]
    reference: Callable[..., Any]
    public: Callable[..., Any]
    kernels: dict[str, Callable[..., Any]] = field(default_factory=dict)


OPERATIONS: dict[str, Operation] = {}
INNER: dict[str, Operation] = {}


def op(**specs: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Register the decorated reference as a public operation with a tensor contract per argument.

    Row pointers given as None mean "one cloud" and reach the body as ``[0, N]``; float inputs must be finite.
    """

    def decorate(reference: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(reference)
        name = reference.__name__
        # Row pointers come last, when the number of rows is known.
        ordered = dict(sorted(specs.items(), key=lambda item: parse_spec(item[1]).is_ptr))
        # Row pointers may be None wherever they stand: that means one cloud.
        required = [
            key
            for key, text in ordered.items()
            if signature.parameters[key].default is inspect.Parameter.empty and not parse_spec(text).is_ptr
        ]

        @functools.wraps(reference)
        def public(*args: P.args, **kwargs: P.kwargs) -> R:
            bound = signature.bind(*args, **kwargs)
            bound.apply_defaults()
            arguments = bound.arguments
            for key in required:
                if arguments[key] is None:
                    raise DTypeError(f"{name}: {key} must be a torch.Tensor, not None")
            _fill_row_pointers(arguments, ordered)
            check_tensors(name, arguments, ordered)
            backend = arguments.pop("backend", "auto")
            device = next(arguments[key].device for key in ordered if isinstance(arguments.get(key), Tensor))
            if backend == "auto" and _wants_gradient(arguments.values()):
                backend = REFERENCE  # kernels know no derivative
            body = _choose(operation, backend, device)
            return body(**arguments)

        operation = OPERATIONS[name] = Operation(name, ordered, reference, public)
        return public

    return decorate


def inner(reference: Callable[P, R]) -> Callable[P, R]:
    """Register the decorated reference as a function without a contract: its callers pass what they have checked.

    The first tensor among its arguments, or inside mappings and sequences among them, says the device.
    """
    name = reference.__name__

    @functools.wraps(reference)
    def function(*args: P.args, **kwargs: P.kwargs) -> R:
        tensors = list(_tensors_in((*args, *kwargs.values())))
        if not tensors or _wants_gradient(tensors):
            return reference(*args, **kwargs)
        body: Callable[P, R] = _choose(operation, "auto", tensors[0].device)
        return body(*args, **kwargs)

    operation = INNER[name] = Operation(name, {}, reference, function)
    return function


def kernel(name: str, backend: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Register a faster body of operation ``name``; it is called with keyword arguments and no ``backend``.

    The body of an inner function is called as the function was.
    """

    def decorate(body: Callable[P, R]) -> Callable[P, R]:
        registry = OPERATIONS if name in OPERATIONS else INNER
        registry[name].kernels[backend] = body
        return body

    return decorate


@functools.cache
def why_unavailable(backend: str) -> str | None:
    """Load a backend; return None when it is live, else the reason and what to do."""
    if backend == REFERENCE:
        return None
    module = importlib.import_module(BACKEND_MODULES[backend])
    reason: str | None = module.unavailable()
    return reason


def backends() -> list[str]:
    """Every backend name that ``backend=`` accepts besides ``"auto"``."""
    return [REFERENCE, *BACKEND_MODULES]


def _fill_row_pointers(arguments: dict[str, Any], specs: dict[str, str]) -> None:
    rows_of = {
        spec.dims[0]: arguments[key]
        for key, text in specs.items()
        if not (spec := parse_spec(text)).is_ptr and isinstance(arguments.get(key), Tensor) and arguments[key].ndim
    }
    for key, text in specs.items():
        spec = parse_spec(text)
        if spec.is_ptr and arguments.get(key) is None and spec.dims[0] in rows_of:
            rows = rows_of[spec.dims[0]]
            arguments[key] = torch.tensor([0, rows.shape[0]], device=rows.device)


def _wants_gradient(arguments: Iterable[Any]) -> bool:
    return torch.is_grad_enabled() and any(isinstance(one, Tensor) and one.requires_grad for one in arguments)


def _tensors_in(arguments: Iterable[Any]) -> Iterator[Tensor]:
    for one in arguments:
        if isinstance(one, Tensor):
            yield one
        elif isinstance(one, Mapping):
            yield from _tensors_in(one.values())
        elif isinstance(one, (list, tuple)):
            yield from _tensors_in(one)


def _choose(operation: Operation, backend: str, device: torch.device) -> Callable[..., Any]:
    if backend == "auto":
        candidates = AUTO_ORDER.get(device.type, (REFERENCE,))
        backend = next(
            name
            for name in candidates
            if name == REFERENCE or (why_unavailable(name) is None and name in operation.kernels)
        )
    if backend == REFERENCE:
        return functools.partial(_call_reference, operation.reference)
    if backend not in BACKEND_MODULES:
        raise BackendError(
            f"{operation.name}: unknown backend {backend!r}; known: 'auto', {', '.join(map(repr, backends()))}"
            f"{near_matches(str(backend), ['auto', *backends()])}"
        )
    reason = why_unavailable(backend)
    if reason is not None:
        raise BackendError(f"{operation.name}: backend {backend!r} is not available: {reason}")
    if backend not in operation.kernels:
        raise BackendError(f"{operation.name}: backend {backend!r} has no kernel for it; use backend='auto'")
    return operation.kernels[backend]


def _call_reference(reference: Callable[..., Any], *args: Any, **arguments: Any) -> Any:
    return reference(*args, **arguments)
