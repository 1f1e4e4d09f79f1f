"""Clouds that the tests of compiled kernels share, and what their results are compared by."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def organized(rows: int, columns: int) -> Tensor:
    """A tilted table with a ball on it and millimetre depth, in scan order."""
    v, u = torch.meshgrid(torch.arange(rows) / rows, torch.arange(columns) / columns, indexing="ij")
    ball = (0.04 - (u - 0.5) ** 2 - (v - 0.5) ** 2).clamp(min=0).sqrt()
    z = ((0.8 - 0.2 * v - ball) * 1000).round() / 1000
    return torch.stack([(u - 0.5) * z, (v - 0.5) * z, z], dim=-1).reshape(-1, 3)


def line(count: int) -> Tensor:
    return torch.arange(float(count))[:, None] * torch.tensor([1.0, 2.0, -1.0])


# name -> points and points per cloud
CLOUDS: dict[str, tuple[Tensor, list[int]]] = {
    "organized": (organized(60, 80), [4800]),
    "shuffled": (organized(60, 80)[torch.randperm(4800, generator=torch.Generator().manual_seed(0))], [4800]),
    "duplicates": (torch.randint(3, (500, 3), generator=torch.Generator().manual_seed(0)).float(), [500]),
    "all the same": (torch.ones(100, 3), [100]),
    "collinear": (line(300), [300]),
    "a kilometre in millimetres": (random(900, 3) * 1e6, [900]),
    "a million metres": (torch.cat([random(500, 3), torch.tensor([[1e6, -1e6, 1e6]])]), [501]),
    "beyond the square root of float32": (random(300, 3) * 1e30, [300]),
    "so small that squares vanish": (random(300, 3) * 1e-24, [300]),
    "signed zeros": (torch.tensor([[0.0, -0.0, 0.0], [-0.0, 0.0, -0.0], [1.0, -0.0, 0.0]]), [3]),
    "one point": (torch.tensor([[1.0, 2.0, 3.0]]), [1]),
    "ragged": (random(1500, 3), [0, 700, 1, 0, 33, 766, 0]),
    "large": (organized(200, 300), [60_000]),
    "large and small": (torch.cat([random(5, 3), organized(150, 200), random(40, 3)]), [5, 30_000, 40]),
    "empty": (torch.empty(0, 3), [0]),
}


def outcome(function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """The result, or the error's type and text: kernels must raise what the reference raises."""
    try:
        return function(*args, **kwargs)
    except Exception as error:
        return type(error), str(error)


REFERENCES: dict[tuple[object, ...], Any] = {}  # of cases with a name: computed once for all machines


def reference_of(case: tuple[object, ...] | None, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    if case is None:
        return outcome(function, *args, **kwargs, backend="torch")
    key = (function.__name__, *case)
    if key not in REFERENCES:
        REFERENCES[key] = outcome(function, *args, **kwargs, backend="torch")
    return REFERENCES[key]


def assert_equal_to_reference(
    function: Callable[..., Any], *args: Any, case: tuple[object, ...] | None = None, **kwargs: Any
) -> None:
    assert_same(outcome(function, *args, **kwargs, backend="cpu"), reference_of(case, function, *args, **kwargs))


def assert_same(ours: Any, reference: Any) -> None:
    if isinstance(reference, Tensor):
        assert isinstance(ours, Tensor), ours
        assert ours.dtype == reference.dtype
        assert torch.equal(ours, reference)
    elif isinstance(reference, tuple):
        assert len(ours) == len(reference)
        for one, other in zip(ours, reference):
            assert_same(one, other)
    else:
        assert ours == reference


def extent_of(points: Tensor) -> float:
    return float((points.double().amax(0) - points.double().amin(0)).max()) if len(points) else 1.0
