"""What tests of the compiled core share: references that answer each question once, and what sanitizers run."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
import hashlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from pcdata.contracts.dispatch import OPERATIONS, REFERENCE, _Operation, why_unavailable
from pcdata.kernels.cpu import native
from tests.sanitized import UNDER_SANITIZERS, repeats_in_memory

# A grid of pixels tells the tree nothing.
SEES_NO_GRID = "torch_tree"


def key_of(value: Any) -> Any:
    """What tells an argument apart from any other: bits and layout of tensors."""
    if isinstance(value, Tensor):
        assert not value.requires_grad
        bits = value.contiguous().view(-1).numpy().tobytes()
        return value.dtype, value.shape, value.stride(), hashlib.blake2b(bits).digest()
    if isinstance(value, (list, tuple)):
        return tuple(map(key_of, value))
    if dataclasses.is_dataclass(value):
        return tuple(key_of(getattr(value, field.name)) for field in dataclasses.fields(value))
    assert value is None or isinstance(value, (bool, int, float, str)), type(value)
    return type(value), repr(value)


def left_to_it(given: tuple[Any, ...], arguments: Mapping[str, Any]) -> bool:
    """Say whether only the reference itself will do: for a gradient, or where a kernel hands it its own arguments."""
    return bool(given) or any(isinstance(value, Tensor) and value.requires_grad for value in arguments.values())


def answered_once(name: str, body: Callable[..., Any]) -> Callable[..., Any]:
    """The same body, which computes nothing twice."""
    answers: dict[Any, Any] = {}

    @functools.wraps(body)
    def answer(*given: Any, **arguments: Any) -> Any:
        if left_to_it(given, arguments):
            return body(*given, **arguments)
        key = tuple((at, key_of(value)) for at, value in arguments.items() if (name, at) != (SEES_NO_GRID, "grid"))
        if key not in answers:
            if len(answers) > 1000:  # a long run of random cases would fill the memory
                answers.clear()
            answers[key] = body(**arguments)
        return copy.deepcopy(answers[key])  # callers may change what they get

    return answer


def answered_by_the_core(operation: _Operation, body: Callable[..., Any]) -> Callable[..., Any]:
    """The core's body, but for what that leaves to the reference itself."""

    @functools.wraps(body)
    def answer(*given: Any, **arguments: Any) -> Any:
        if left_to_it(given, arguments):
            return body(*given, **arguments)
        plain = {name: value.contiguous() if isinstance(value, Tensor) else value for name, value in arguments.items()}
        return operation.kernels["cpu"](**plain)

    return answer


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not UNDER_SANITIZERS or why_unavailable("cpu") is not None:
        return
    best, repeated = native.best_instruction_set(), []
    for item in items:
        parameters = item.callspec.params if hasattr(item, "callspec") else {}
        if repeats_in_memory(item.nodeid, parameters, best):
            repeated.append(item)
    left_out = set(repeated)
    kept = [item for item in items if item not in left_out]
    functions = [{item.nodeid.partition("[")[0] for item in some} for some in (repeated, kept)]
    assert functions[0] <= functions[1], f"no case is left of {functions[0] - functions[1]}"
    config.hook.pytest_deselected(items=repeated)
    items[:] = kept


@pytest.fixture(autouse=True, scope="module")
def references() -> Iterator[None]:
    """Instruction sets, numbers of threads and grids share the references' answers, within a file."""
    live = [name for name in ("torch_tree", "cpu") if why_unavailable(name) is None]
    with pytest.MonkeyPatch.context() as patch:
        for operation in OPERATIONS.values():
            if "cpu" not in live or "cpu" not in operation.kernels or operation.mutates or operation.steps:
                continue
            for name, body in {REFERENCE: operation.reference, **operation.kernels}.items():
                if name not in (REFERENCE, "torch_tree"):
                    continue
                instead = answered_by_the_core(operation, body) if UNDER_SANITIZERS else answered_once(name, body)
                if name == REFERENCE:
                    patch.setattr(operation, "reference", instead)
                else:
                    patch.setitem(operation.kernels, name, instead)
        yield


@contextlib.contextmanager
def library_of(name: str | None) -> Iterator[None]:
    """The core runs in one instruction set; None: in the best."""
    with pytest.MonkeyPatch.context() as patch:
        if name is not None:
            patch.setenv(native.FORCE_VARIABLE, name)
        native.library.cache_clear()
        try:
            native.library()
        except OSError as error:
            if "this processor runs" not in str(error):
                raise
            pytest.skip(str(error))
        yield
    native.library.cache_clear()


@pytest.fixture(params=native.INSTRUCTION_SETS)
def instruction_set(request: pytest.FixtureRequest) -> Iterator[str]:
    """Each instruction set that this processor runs, in turn."""
    with library_of(request.param):
        yield request.param


@pytest.fixture(params=[(1, None), (7, None), *((2, name) for name in native.INSTRUCTION_SETS)], ids=str)
def machine(request: pytest.FixtureRequest) -> Iterator[None]:
    """A number of threads, and the library of one instruction set (None: the best)."""
    threads, name = request.param
    before = torch.get_num_threads()
    with library_of(name):
        torch.set_num_threads(threads)
        yield
        torch.set_num_threads(before)


@pytest.fixture(scope="module")
def frame(test_data: Path) -> tuple[Tensor, Tensor]:
    """Depth (1, H, W) metres and intrinsics of a real frame."""
    depth = np.array(pytest.importorskip("PIL.Image").open(test_data / "graspnet_frame/depth.png"))
    meta = pytest.importorskip("scipy.io").loadmat(test_data / "graspnet_frame/meta.mat")
    metres = torch.from_numpy(depth.astype(np.float32) / 1000)[None]
    return metres, torch.from_numpy(meta["intrinsic_matrix"].astype(np.float64))[None]
