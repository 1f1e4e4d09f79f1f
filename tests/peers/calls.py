"""What a row of docs/coming_from.md is, and how two results are compared."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import torch

import pcdata
import pcdata.validation.measures.earth_movers
from pcdata.rng import seeded
from pcdata.synthetic import SyntheticSource

Names = dict[str, Any]
Agreement = Callable[[Any, Any, Names], None]


@dataclass(frozen=True)
class Call:
    """One row: their expression, ours, and what differs."""

    theirs: str
    ours: str
    differs: str = ""
    agree: Agreement | None = None  # of their result, ours, and the names they saw; None = not to be compared
    runs: bool = True  # False: words about their call, or a part of the library that its wheels lack


@dataclass(frozen=True)
class Section:
    """The calls of one library."""

    title: str
    note: str
    calls: tuple[Call, ...]
    modules: Mapping[str, str] = field(default_factory=dict)  # name in their expressions -> module; none = only read
    setup: str = ""  # makes what their expressions name
    missing: tuple[tuple[str, str], ...] = ()  # what is not here, and why or what to do


def names() -> Names:
    """What every expression sees, with new tensors each time."""
    found = {name: value.clone() if isinstance(value, torch.Tensor) else value for name, value in _data().items()}
    return {**found, "generator": torch.Generator().manual_seed(0)}


def names_of(section: Section) -> Names | None:
    """What the expressions of a library see; None where it is not installed."""
    found = names()
    try:
        for name, module in section.modules.items():
            found[name] = importlib.import_module(module)
    except ImportError:
        return None
    exec(section.setup, found)
    return found


@cache
def _data() -> Names:
    generator = seeded(7)
    points = torch.rand(200, 3, generator=generator) * 0.2
    points[::2, 2] = 0.1
    normals = torch.nn.functional.normalize(torch.randn(200, 3, generator=generator), dim=1)
    source = SyntheticSource(num_scenes=1, num_views=2, size=(24, 32))
    frame = source.load(source.ids[0])
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))[0]
    pose[:3, :3] *= torch.linalg.det(pose[:3, :3])
    pose[:3, 3] = 0.1
    grid = torch.cartesian_prod(torch.arange(40), torch.arange(40)).float() * 0.005
    labels = torch.arange(200) % 3
    return {
        "np": np,
        "torch": torch,
        "pcdata": pcdata,
        "F": pcdata.functional,
        "points": points,
        "others": torch.rand(150, 3, generator=generator) * 0.2,
        "queries": torch.rand(50, 3, generator=generator) * 0.2,
        "ptr": torch.tensor([0, 80, 160, 200]),
        "queries_ptr": torch.tensor([0, 20, 40, 50]),
        "batch": torch.arange(200) // 80,
        "queries_batch": torch.arange(50) // 20,
        "normals": normals,
        "other_normals": torch.nn.functional.normalize(torch.randn(150, 3, generator=generator), dim=1),
        "labels": labels,
        "features": torch.rand(200, 4, generator=generator),
        "weights": torch.rand(200, generator=generator),
        "pose": pose,
        "moved": (points.double() @ pose[:3, :3].T + pose[:3, 3]).float(),
        "surface": torch.cat([grid, 0.03 * torch.sin(grid.sum(1, keepdim=True) * 30)], dim=1),
        "cloud": pcdata.PointCloud(
            points=points,
            normals=normals,
            colors=points * 5,
            labels=labels,
            frame_id="base",
            viewpoint=torch.zeros(1, 3),
        ),
        "frame": frame,
        "depth": frame.depth,
        "K": frame.camera.intrinsics,
        "lens": torch.tensor([[0.05, -0.02, 0.001, -0.002, 0.01]], dtype=torch.float64),
        "xy": torch.rand(30, 2, generator=generator, dtype=torch.float64) * 0.5,
    }


def by(theirs: Callable[[Any], Any], ours: Callable[[Any], Any], tolerance: float = 1e-6) -> Agreement:
    """Compare the numbers that two functions take out of the results."""

    def check(a: Any, b: Any, _: Names) -> None:
        a, b = np.squeeze(array(theirs(a))), np.squeeze(array(ours(b)))
        np.testing.assert_allclose(b, a, rtol=tolerance, atol=tolerance)

    return check


def same(tolerance: float = 1e-6) -> Agreement:
    """Compare the results as they are."""
    return by(array, array, tolerance)


def array(values: Any) -> Any:
    """Numbers of any library as NumPy's."""
    for method in ("detach", "cpu", "numpy"):
        values = getattr(values, method)() if hasattr(values, method) else values
    return np.asarray(values)


def in_order(rows: Any) -> Any:
    """Rows sorted by their columns: for results whose order means nothing."""
    rows = np.round(array(rows).astype(np.float64), 5)
    return rows[np.lexsort(rows.T)] if rows.ndim > 1 else np.sort(rows)


def rows_of(mask: Any) -> Any:
    """The rows where a mask is True."""
    return np.flatnonzero(array(mask))


def both_signs(normals: Any) -> Any:
    """The (N, 3, 3) products of normals with themselves: the same for both signs."""
    normals = array(normals)
    return normals[:, :, None] * normals[:, None, :]
