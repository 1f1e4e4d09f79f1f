"""A device that no machine has: tensors that live on the processor, but refuse what a real device refuses.

``pretend(tensor)`` puts a tensor on it. Operations on such tensors run on the processor, so that their results can be
compared bit for bit. What a GPU would refuse is refused: tensors of two devices in one operation, ``numpy()``,
addresses. What makes a GPU wait is counted: see ``Watched``. Kernels of the processor are never chosen for it, as
``device.type`` is another.

It rests on an interface that PyTorch calls experimental (``torch.utils.backend_registration``); ``AVAILABLE`` says
whether it is there.
"""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import torch.utils.backend_registration
from torch import Tensor
from torch.utils._pytree import tree_map

NAME = "pretend"
SET_UP = getattr(torch.utils.backend_registration, "_setup_privateuseone_for_python_backend", None)
AVAILABLE = SET_UP is not None
HOST = torch.device("cpu")

# The host waits for these: a number is asked for, or the size of the result is a value of the device. It waits for a
# copy to the device too, unless that is said to be non-blocking.
WAITS = {
    "_local_scalar_dense",
    "_unique2",
    "argwhere",
    "bincount",
    "equal",
    "is_nonzero",
    "masked_select",
    "nonzero",
    "unique_consecutive",
    "unique_dim",
    "unique_dim_consecutive",
}
INDEXING = {"index", "index_put", "index_put_", "_index_put_impl_"}  # the indices may be the host's
MAY_MIX = INDEXING | {"copy_", "_to_copy", "set_"}
# These start nothing on the device.
VIEWS = {
    *("_reshape_alias", "_unsafe_view", "alias", "as_strided", "detach", "diagonal", "empty", "empty_like"),
    *("empty_strided", "expand", "lift_fresh", "new_empty", "new_empty_strided", "permute", "select", "slice", "split"),
    *("split_with_sizes", "squeeze", "t", "transpose", "unbind", "unfold", "unsqueeze", "view"),
}
FACTORIES = (
    *("arange", "arange.start", "arange.start_step", "empty.memory_format", "empty_strided", "eye", "eye.m"),
    *("linspace", "randperm", "tril_indices", "triu_indices"),
)


@dataclass
class Watched:
    """What operations on the device did: ``waits`` of the host and ``uploads`` by place, ``launches``."""

    waits: Counter[str] = field(default_factory=Counter)
    uploads: Counter[str] = field(default_factory=Counter)
    launches: int = 0


_watching: list[Watched] = []


class Recording:
    """What the device was asked to do, in order, to be done again: as a CUDA graph, with the same memory.

    What a graph cannot hold is refused: the host waits for a value, or sends one.
    """

    def __init__(self) -> None:
        self.done: list[tuple[str, Callable[[], None]]] = []  # what it is, with all that it is asked with
        self.kept: list[Any] = []  # memory that is written to again

    def add(self, what: str, again: Callable[[], None], *kept: Any) -> None:
        self.done.append((what, again))
        self.kept.append(kept)

    def add_operation(self, name: str, function: Any, arguments: tuple, options: dict, found: Any) -> None:
        results = list(_plain_tensors((found,)))

        def again() -> None:
            for into, one in zip(results, _plain_tensors((function(*arguments, **options),)), strict=True):
                if into is not one:
                    assert into.shape == one.shape, f"aten::{name} gives another size"
                    into.copy_(one)

        self.add(f"aten::{name}", again, found, arguments, options)

    def replay(self) -> None:
        for _, again in self.done:
            again()


_recordings: list[Recording] = []


@contextmanager
def recording() -> Iterator[Recording]:
    made = Recording()
    _recordings.append(made)
    try:
        yield made
    finally:
        _recordings.pop()


@contextmanager
def watching() -> Iterator[Watched]:
    watched = Watched()
    _watching.append(watched)
    try:
        yield watched
    finally:
        _watching.pop()


def pretend(tensor: Tensor) -> Tensor:
    """Put a tensor of the host on the device."""
    _register()
    return tensor if isinstance(tensor, PretendTensor) else PretendTensor(tensor.detach())


def device() -> torch.device:
    """Return the device, for ``.to(device())``."""
    _register()
    return torch.device(NAME, 0)


def host(tensor: Tensor) -> Tensor:
    """The tensor on the host, uncounted."""
    return tensor.inner if isinstance(tensor, PretendTensor) else tensor


class PretendTensor(Tensor):
    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> PretendTensor:
        return Tensor._make_wrapper_subclass(
            cls,
            inner.size(),
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            device=device(),
        )

    def __init__(self, inner: Tensor) -> None:
        self.inner = inner

    __torch_function__ = torch._C._disabled_torch_function_impl  # results stay what dispatch makes them

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, arguments: tuple = (), options: dict | None = None) -> Any:
        return run(function, arguments, options or {})

    def tolist(self) -> Any:
        _waited("tolist")
        return self.inner.tolist()

    def numpy(self, *, force: bool = False) -> Any:
        raise TypeError(f"can't convert {self.device} device type tensor to numpy")

    def __array__(self, *arguments: Any, **options: Any) -> Any:
        return self.numpy()

    def data_ptr(self) -> int:
        raise RuntimeError("an address of the device was asked for")

    def __repr__(self, **_: Any) -> str:
        return f"PretendTensor({self.inner!r})"


def run(function: Any, arguments: tuple, options: dict) -> Any:
    name = function._schema.name.removeprefix("aten::")
    given = [*arguments, *options.values()]
    tensors = list(_tensors_in(given))
    of_host = [tensor for tensor in tensors if not isinstance(tensor, PretendTensor)]
    target = options.get("device")
    if of_host and len(of_host) < len(tensors):
        if name in MAY_MIX:
            _mixed(name, tensors, is_blocking=not any(value is True for value in given))
        elif any(tensor.ndim for tensor in of_host):
            raise RuntimeError(f"Expected all tensors to be on the same device: aten::{name} got {NAME} and cpu")
    if name in WAITS or (name in INDEXING and _has_mask(tensors[1:2])):
        _waited(name)
    if name == "repeat_interleave" and options.get("output_size") is None:
        _waited(name)
    to_host = name == "_to_copy" and target is not None and torch.device(target).type == "cpu"
    if to_host:
        _waited("to the host")
    if name == "_to_copy" and not any(isinstance(tensor, PretendTensor) for tensor in tensors):
        _uploaded(name, waits=not options.get("non_blocking"))
    if name not in VIEWS:
        for watched in _watching:
            watched.launches += 1
    inner_options = {key: HOST if isinstance(value, torch.device) else value for key, value in options.items()}
    found = function(*tree_map(_inner, arguments), **tree_map(_inner, inner_options))
    for made in _recordings:
        if name not in VIEWS:
            made.add_operation(name, function, tree_map(_inner, arguments), tree_map(_inner, inner_options), found)
        made.kept.append(found)
    if name == "copy_" and not isinstance(arguments[0], PretendTensor):
        return arguments[0]
    if to_host:
        return found
    own = {id(tensor.inner): tensor for tensor in tensors if isinstance(tensor, PretendTensor)}
    return tree_map(lambda value: own[id(value)] if id(value) in own else _outer(value), found)


def _mixed(name: str, tensors: list[Tensor], *, is_blocking: bool) -> None:
    if name == "copy_" and not isinstance(tensors[0], PretendTensor):
        _waited("copy_ to the host")
    elif name in INDEXING and not isinstance(tensors[0], PretendTensor):
        raise RuntimeError(f"indices should be on the same device as the indexed tensor (cpu): aten::{name}")
    elif any(tensor.ndim for tensor in tensors if not isinstance(tensor, PretendTensor)):
        _uploaded(name, waits=is_blocking or name in INDEXING)


def _has_mask(tensors: list[Tensor]) -> bool:
    return any(tensor.dtype == torch.bool for tensor in tensors)


def _inner(value: Any) -> Any:
    return value.inner if isinstance(value, PretendTensor) else value


def _outer(value: Any) -> Any:
    return PretendTensor(value) if isinstance(value, Tensor) else value


def _tensors_in(values: Any) -> Iterator[Tensor]:
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, list | tuple):
            yield from _tensors_in(value)


def _plain_tensors(values: Any) -> Iterator[Tensor]:
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, list | tuple):
            yield from _plain_tensors(value)


def _waited(what: str) -> None:
    if _recordings:
        raise RuntimeError(f"a graph cannot hold what the host waits for: {what} in {_place()}")
    for watched in _watching:
        watched.waits[f"{what} in {_place()}"] += 1


def _uploaded(what: str, *, waits: bool) -> None:
    if waits or _recordings:
        _waited(f"upload by {what}")
    for watched in _watching:
        watched.uploads[f"{what} in {_place()}"] += 1


def _place() -> str:
    """The innermost line of the package that is at work."""
    for frame in reversed(traceback.extract_stack()):
        path = Path(frame.filename)
        if "pcdata" in path.parts and "tests" not in path.parts and "site-packages" not in path.parts:
            parts = path.parts
            return f"{'/'.join(parts[parts.index('pcdata', max(0, len(parts) - 6)) :])}:{frame.lineno}"
    return "elsewhere"


_registered: list[torch.library.Library] = []


def _register() -> None:
    if _registered:
        return
    assert SET_UP is not None, "this PyTorch has no devices written in Python"
    SET_UP(NAME)
    module = torch.get_device_module(NAME)  # has no state of random numbers, which torch.random.fork_rng asks for
    module.get_rng_state, module.set_rng_state = (lambda device=None: None), (lambda state, device=None: None)
    library = torch.library.Library("aten", "IMPL")
    _registered.append(library)
    for name in FACTORIES:
        packet, _, overload = name.partition(".")
        function = getattr(getattr(torch.ops.aten, packet), overload or "default")
        library.impl(name, _factory(function), "PrivateUse1")
    library.impl("_copy_from", _copy_from, "PrivateUse1")


def _copy_from(source: Tensor, target: Tensor, non_blocking: bool = False) -> Tensor:
    if isinstance(target, PretendTensor):
        _uploaded("copy_", waits=not non_blocking)
    else:
        _waited("copy_")
    host(target).copy_(host(source))
    return target


def _factory(function: Any) -> Any:
    def make(*arguments: Any, **options: Any) -> Tensor:
        options = {**options, "device": HOST}
        found = function(*arguments, **options)
        for recorded in _recordings:
            if not function._schema.name.startswith("aten::empty"):
                recorded.add_operation(function._schema.name, function, arguments, options, found)
            recorded.kept.append(found)
        return PretendTensor(found)

    return make
