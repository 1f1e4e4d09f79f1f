"""Which body computes a step of fusion: the plain torch reference on any device, or the compiled core on the CPU.

These steps change a volume in place, which an operation of :mod:`pcdata.contracts.dispatch` must not; the choice is
the same.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.dispatch import BACKEND_MODULES, REFERENCE, backends, first_live, why_unavailable
from pcdata.errors import BackendError, near_matches
from pcdata.functional.tsdf import integrate, marching, surface, views
from pcdata.functional.tsdf.blocks import VoxelBlocks
from pcdata.functional.tsdf.grid import VoxelGrid
from pcdata.functional.tsdf.surface import Crossings
from pcdata.functional.tsdf.views import FusionView

# (step, backend) -> body; the core's join when it is loaded.
BODIES: dict[tuple[str, str], Callable[..., Any]] = {
    ("pack_colors", REFERENCE): views.pack_colors,
    ("touched_blocks", REFERENCE): integrate.touched_blocks,
    ("find_blocks", REFERENCE): integrate.find_blocks,
    ("integrate_view", REFERENCE): integrate.integrate_view,
    ("find_crossings", REFERENCE): surface.find_crossings,
    ("find_triangles", REFERENCE): marching.find_triangles,
}


def pack_colors(colors: Tensor, *, backend: str = "auto") -> Tensor:
    """See :func:`pcdata.functional.tsdf.views.pack_colors`."""
    packed: Tensor = _body("pack_colors", backend, colors.device)(colors)
    return packed


def touched_blocks(view: FusionView, grid: VoxelGrid, *, backend: str = "auto") -> Tensor:
    """See :func:`pcdata.functional.tsdf.integrate.touched_blocks`."""
    keys: Tensor = _body("touched_blocks", backend, view.depth.device)(view, grid)
    return keys


def find_blocks(blocks: VoxelBlocks, keys: Tensor, *, backend: str = "auto") -> tuple[Tensor, Tensor]:
    """See :func:`pcdata.functional.tsdf.integrate.find_blocks`."""
    found: tuple[Tensor, Tensor] = _body("find_blocks", backend, blocks.device)(blocks, keys)
    return found


def integrate_view(
    blocks: VoxelBlocks, rows: Tensor, view: FusionView, grid: VoxelGrid, *, carve: bool, backend: str = "auto"
) -> None:
    """See :func:`pcdata.functional.tsdf.integrate.integrate_view`."""
    _body("integrate_view", backend, blocks.device)(blocks, rows, view, grid, carve=carve)


def find_crossings(
    blocks: VoxelBlocks, grid: VoxelGrid, *, min_weight: int = 1, edges: bool = False, backend: str = "auto"
) -> Crossings:
    """See :func:`pcdata.functional.tsdf.surface.find_crossings`."""
    body = _body("find_crossings", backend, blocks.device)
    found: Crossings = body(blocks, grid, min_weight=min_weight, edges=edges)
    return found


def find_triangles(
    blocks: VoxelBlocks, edge: Tensor, *, min_weight: int = 1, backend: str = "auto"
) -> tuple[Tensor, Tensor]:
    """See :func:`pcdata.functional.tsdf.marching.find_triangles`."""
    used, triangles = _body("find_triangles", backend, blocks.device)(blocks, edge, min_weight=min_weight)
    return used, triangles


def _body(step: str, backend: str, device: torch.device) -> Callable[..., Any]:
    if backend == "auto":
        backend = first_live(device, lambda name: (step, name) in BODIES)
    if backend != REFERENCE and backend not in BACKEND_MODULES:
        raise BackendError(f"{step}: unknown backend {backend!r}{near_matches(str(backend), ['auto', *backends()])}")
    reason = why_unavailable(backend)
    if reason is None and (step, backend) not in BODIES:
        reason = "it has no kernel for this step"
    if reason is not None:
        raise BackendError(f"{step}: backend {backend!r} is not available: {reason}; use backend='auto'")
    return BODIES[step, backend]
