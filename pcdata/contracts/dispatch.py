"""One public function per operation; several bodies may compute it.

``@op`` marks the public function: its own body is the reference, plain torch on any device. ``@kernel`` registers a
faster body beside it under a backend name; it receives arguments that already passed the contract, and must give the
same result. ``backend="auto"`` takes the fastest live backend for the device, and no kernel where a gradient is wanted
and the operation gives one; naming an absent backend raises with the reason. Where the body that ``auto`` would take is
absent, and a slow one serves, a :class:`~pcdata.errors.SlowBackendWarning` says so once.

``@inner`` marks what only pcdata itself calls, with tensors that it has checked already (picking rows, moving points):
kernels register beside it in the same way, but there is no contract to check.

A reference may leave its work to ``steps``, functions that it tells its ``backend``: a backend that serves every step
then serves the operation without a kernel of its own.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import multiprocessing
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

from pcdata.contracts.arguments import Contract
from pcdata.contracts.compiling import called_apart, is_traced
from pcdata.contracts.numbers import Spec
from pcdata.contracts.operators import Traced
from pcdata.errors import BackendError, SlowBackendWarning, near_matches

P = ParamSpec("P")
R = TypeVar("R")

REFERENCE = "torch"

# Backend name -> module that registers its kernels when imported and defines `unavailable() -> str | None`.
BACKEND_MODULES = {
    "cpu": "pcdata.kernels.cpu",
    "cuda": "pcdata.kernels.cuda",
    "torch_tree": "pcdata.kernels.torch_tree",
    "torch_cluster": "pcdata.kernels.torch_cluster",
}

# What `auto` tries, best first. torch_cluster is chosen only by name: it covers few calls.
AUTO_ORDER: dict[str, tuple[str, ...]] = {
    "cpu": ("cpu", "torch_tree", REFERENCE),
    "cuda": ("cuda", "torch_tree", REFERENCE),
}
# The devices whose memory a backend reads; one that is not named here takes any.
DEVICES_OF: dict[str, tuple[str, ...]] = {"cpu": ("cpu",), "cuda": ("cuda",)}
OTHER_DEVICES = ("torch_tree", REFERENCE)


@dataclass
class _Operation:
    """A registered operation: its contract, its reference and its kernels."""

    name: str
    reference: Callable[..., Any]
    public: Callable[..., Any]
    contract: Contract | None = None  # None for an inner function
    gradient: bool = True  # whether results carry one to the inputs
    mutates: tuple[str, ...] = ()  # arguments that it changes in place
    steps: tuple[_Operation, ...] = ()  # that the reference calls with its backend
    kernels: dict[str, Callable[..., Any]] = field(default_factory=dict)
    roomy: set[str] = field(default_factory=set)  # backends whose kernel takes arrays with room: see kernel()

    def serves(self, backend: str) -> bool:
        """Say whether a backend, once loaded, computes this operation."""
        return backend == REFERENCE or backend in self.kernels or self.serves_by_steps(backend)

    def serves_by_steps(self, backend: str) -> bool:
        """Say whether a backend serves all steps: the reference then runs on it, gradients and all."""
        return bool(self.steps) and all(backend in step.kernels or step.serves_by_steps(backend) for step in self.steps)


OPERATIONS: dict[str, _Operation] = {}
INNER: dict[str, _Operation] = {}


def registered(name: str) -> _Operation:
    """Return an operation or an inner function by its name."""
    return OPERATIONS.get(name) or INNER[name]


def op(
    *,
    gradient: bool = True,
    mutates: tuple[str, ...] = (),
    steps: tuple[Callable[..., Any], ...] = (),
    traced: Traced | None = None,
    **specs: str | Spec,
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Register the decorated reference as a public operation with a contract per argument.

    Row pointers given as None mean "one cloud" and reach the body as ``[0, N]``; float inputs must be finite. Kernels
    get contiguous tensors without a gradient, whatever the caller's look like.

    Args:
        gradient: whether results carry one to the inputs; with False no body ever sees a tensor that requires one.
        mutates: arguments that it changes in place, to the same values on every backend; all others stay as they are.
        steps: functions that the reference calls with its ``backend``.
        traced: how a compiler keeps it whole; None = a compiled program is cut where it calls the operation.
        specs: argument name -> contract: of tensors a string, see :mod:`pcdata.contracts.tensors`; of others a
            function, see :mod:`pcdata.contracts.numbers`.
    """

    def decorate(reference: Callable[P, R]) -> Callable[P, R]:
        contract = Contract.of(reference, specs)
        name = contract.name

        @functools.wraps(reference)
        def public(*args: P.args, **kwargs: P.kwargs) -> R:
            if is_traced():
                found: R | None = None if operator is None else operator(defaults, args, kwargs)
                return called_apart(public, *args, **kwargs) if found is None else found
            arguments = contract.bind(args, kwargs)
            contract.check(arguments)
            backend = arguments.pop("backend", "auto")
            wants_gradient = gradient and torch.is_grad_enabled() and _wants_gradient(arguments.values())
            device = contract.device(arguments)
            backend = _choose(operation, backend, device, wants_gradient)
            body: Callable[..., R] | None = operation.kernels.get(backend)
            if wants_gradient and operation.serves_by_steps(backend):
                body = (
                    None  # the reference, on the kernels of its steps, has the gradient that a kernel of its own lacks
                )
            _tidy(arguments, detach=body is not None or not gradient, contiguous=backend != REFERENCE)
            if body is None and steps:
                arguments["backend"] = backend
            return body(**arguments) if body is not None else operation.reference(**arguments)

        operator = None if traced is None else traced.register(name, public, gradient=gradient)
        # Without a default: an argument that an operator takes, or None, which it cannot.
        defaults = {
            key: None if one.default is one.empty else one.default
            for key, one in inspect.signature(reference).parameters.items()
        }
        operation = OPERATIONS[name] = _Operation(
            name, reference, public, contract, gradient, mutates, tuple(registered(step.__name__) for step in steps)
        )
        return public

    return decorate


def inner(reference: Callable[P, R]) -> Callable[P, R]:
    """Register the decorated reference as a function without a contract: its callers pass what they have checked.

    The first tensor among its arguments, or inside mappings and sequences among them, says the device. A caller that
    was told a backend passes it on as ``backend``.
    """
    name = reference.__name__

    @functools.wraps(reference)
    def function(*args: P.args, **kwargs: P.kwargs) -> R:
        backend = str(kwargs.pop("backend", "auto"))
        if backend == "auto":
            backend = REFERENCE
            tensors: list[Tensor] = []
            _add_tensors((*args, *kwargs.values()), tensors)
            if tensors and not _wants_gradient(tensors):
                backend = first_live(tensors[0].device, operation.serves)
        body: Callable[P, R] = operation.kernels.get(backend, reference)
        return body(*args, **kwargs)

    operation = INNER[name] = _Operation(name, reference, function)
    return function


def kernel(name: str, backend: str, *, roomy: bool = False) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Register a faster body of operation ``name``; it is called with keyword arguments and no ``backend``.

    The body of an inner function is called as the function was.

    Args:
        name: of the operation.
        backend: that it is a body of.
        roomy: its arrays may have room for more rows than their ``ptr`` counts; what lies behind the last is finite and
            changes nothing. Its results have as much room. It waits for the device at most in
            :func:`pcdata.contracts.asked_later.is_set`, so what it starts may be repeated on other values: see
            :func:`roomy_body`.
    """

    def decorate(body: Callable[P, R]) -> Callable[P, R]:
        operation = registered(name)
        operation.kernels[backend] = body
        if roomy:
            operation.roomy.add(backend)
        return body

    return decorate


def held_to(name: str, **arguments: Any) -> dict[str, Any]:
    """Hold the arguments of an inner function that does the work of an operation to its contract; for kernels.

    Raises:
        PcdataError: what the operation would raise.
    """
    contract = OPERATIONS[name].contract
    assert contract is not None  # it is no inner function
    contract.check(arguments)
    _tidy(arguments, detach=True, contiguous=True)
    return arguments


def roomy_body(name: str, device: torch.device) -> Callable[..., Any] | None:
    """Return the body of an operation that takes arrays with room for more rows than their ``ptr`` counts, or None.

    It gets what :func:`op` would have checked, and nobody checks it.
    """
    operation = registered(name)
    backend = first_live(device, operation.serves)
    return operation.kernels[backend] if backend in operation.roomy else None


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


def _wants_gradient(tensors: Iterable[Any]) -> bool:
    for value in tensors:  # not any(): a generator is resumed once per value
        if isinstance(value, Tensor) and value.requires_grad:
            return torch.is_grad_enabled()
    return False


_PLAIN = frozenset((int, float, bool, str, type(None)))


def _add_tensors(arguments: Iterable[Any], found: list[Tensor]) -> None:
    for one in arguments:
        kind = type(one)
        if kind is Tensor:
            found.append(one)
        elif kind in _PLAIN:  # asking what it is an instance of, of mappings most of all, takes longer
            continue
        elif kind is dict:
            _add_tensors(one.values(), found)
        elif isinstance(one, (list, tuple)):
            _add_tensors(one, found)
        elif isinstance(one, Tensor):
            found.append(one)
        elif isinstance(one, Mapping):
            _add_tensors(one.values(), found)


def _tidy(arguments: dict[str, Any], *, detach: bool, contiguous: bool) -> None:
    """Take tensors out of every graph, and lay them out as kernels read memory: row after row, without gaps."""
    for key, value in arguments.items():
        if isinstance(value, Tensor):
            value = value.detach() if detach and value.requires_grad else value
            arguments[key] = value.contiguous() if contiguous else value


def first_live(device: torch.device, has_kernel: Callable[[str], bool]) -> str:
    """Return the backend that ``auto`` takes: the first for the device that is live and has a kernel.

    Warns:
        SlowBackendWarning: once, if a faster one has a kernel but is absent.
    """
    for name in AUTO_ORDER.get(device.type, OTHER_DEVICES):
        if name == REFERENCE:
            break
        reason = why_unavailable(name)  # loads the kernels, if any
        if not has_kernel(name):
            continue
        if reason is None:
            return name
        _warn_of_slow_bodies(device.type, reason)
    return REFERENCE


@functools.cache
def _warn_of_slow_bodies(device_type: str, reason: str) -> None:
    # A process that another one started (a loader's worker, a build's) leaves the word to that one.
    if multiprocessing.parent_process() is None:
        warnings.warn(
            f"operations on {'the CPU' if device_type == 'cpu' else device_type.upper()} run in plain torch, many "
            f"times slower than compiled: {reason}",
            SlowBackendWarning,
            stacklevel=2,
        )


def warn_if_slow() -> None:
    """Give the warning of :func:`first_live` now, where worker processes that stay silent are about to be started."""
    if (reason := why_unavailable("cpu")) is not None:
        _warn_of_slow_bodies("cpu", reason)


def _choose(operation: _Operation, backend: str, device: torch.device, wants_gradient: bool = False) -> str:
    """Return the backend that computes a call; kernels of the operation itself know no derivative."""
    if backend == "auto":
        return first_live(device, operation.serves_by_steps if wants_gradient else operation.serves)
    if backend == REFERENCE:
        return backend
    if backend not in BACKEND_MODULES:
        raise BackendError(
            f"{operation.name}: unknown backend {backend!r}; known: 'auto', {', '.join(map(repr, backends()))}"
            f"{near_matches(str(backend), ['auto', *backends()])}"
        )
    reason = why_unavailable(backend)
    if reason is not None:
        raise BackendError(f"{operation.name}: backend {backend!r} is not available: {reason}")
    if not operation.serves(backend):
        raise BackendError(f"{operation.name}: backend {backend!r} has no kernel for it; use backend='auto'")
    if device.type not in DEVICES_OF.get(backend, (device.type,)):
        raise BackendError(
            f"{operation.name}: backend {backend!r} computes on {' or '.join(DEVICES_OF[backend])}, but the tensors "
            f"are on {device}; move them with .to(), or use backend='auto'"
        )
    return backend
